"""C99 source of trained models."""
