"""Training differential networks on functions."""
