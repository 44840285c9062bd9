"""C99 source of JAX functions."""

from dln_jax.deploy.c.load import load_c
from dln_jax.deploy.c.source import export_c

__all__ = ["export_c", "load_c"]
