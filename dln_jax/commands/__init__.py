"""The commands, one file each: python -m dln_jax NAME."""

__all__ = []
