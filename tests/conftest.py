"""Shared set-up: float64 everywhere, and programs compiled quickly rather than to run fast."""

import os

# Tests run each program a few times: compiling costs them more than running. Read when the first device is used.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"

import jax

jax.config.update("jax_enable_x64", True)
