"""Speed-ups of devices and processes that share batches: measured here, and modelled for n hosts."""
