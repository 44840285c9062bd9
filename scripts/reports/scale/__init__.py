"""What devices and processes that share batches gain, and what they cannot: measured here, and for n hosts on paper."""
