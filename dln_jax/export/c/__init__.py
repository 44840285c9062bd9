"""C99 source of JAX functions."""
