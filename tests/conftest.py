"""Shared set-up: float64 everywhere, physics compiled once."""

import jax

jax.config.update("jax_enable_x64", True)
