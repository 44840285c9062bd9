"""The low-latency mode in processes of its own, and callables of NumPy arrays."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.export.low_latency import low_latency

EARLY = """
import dln_jax
from dln_jax.export.low_latency import enable_low_latency, low_latency
enable_low_latency()
import jax, numpy as np
assert jax.config.read("jax_cpu_enable_async_dispatch") is False
twice = low_latency(lambda q, qd: 2 * q + qd, np.ones(2, np.float32), np.ones(2, np.float32))
result = twice(np.ones(2, np.float32), np.ones(2, np.float32))
assert result.is_ready() and (np.asarray(result) == 3).all()
enable_low_latency()
print("fine")
"""
LATE = """
import jax
from dln_jax.export.low_latency import enable_low_latency
from dln_jax.types import InputError
jax.devices()
try:
    enable_low_latency()
except InputError as error:
    assert jax.config.read("jax_cpu_enable_async_dispatch") is True
    print(error)
"""


@pytest.mark.parametrize(("program", "text"), [(EARLY, "fine"), (LATE, "JAX has already started its backend")])
def test_the_mode_is_set_before_the_backend_starts_or_refused(program, text):
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, result.stderr
    assert text in result.stdout and result.stdout.count("\n") == 1


def test_a_function_is_compiled_before_the_loop_starts():
    double = low_latency(lambda x: 2 * x, np.zeros(2))
    programs = double._cache_size()
    assert isinstance(double(jnp.ones(2)), jax.Array) and isinstance(double(np.ones(2)), jax.Array)
    assert double._cache_size() == programs  # for NumPy and device arrays alike


def test_examples_are_needed():
    with one_line("no example"):
        low_latency(lambda: 0)
