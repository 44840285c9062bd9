"""Quality of uncertainty estimates: coverage of bands on held-out motions, and out-of-distribution flags."""
