"""Low-latency functions and C99 source of a model."""
