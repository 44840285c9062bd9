"""The low-latency mode in processes of its own, and callables of NumPy arrays."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.export.low_latency import low_latency
from dln_jax.mechanics.dynamics import Decomposition

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


@pytest.mark.parametrize(("program", "text"), [(EARLY, "fine"), (LATE, "was called after JAX had started its backend")])
def test_the_mode_is_set_before_the_backend_starts_or_refused(program, text):
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, result.stderr
    assert text in result.stdout and result.stdout.count("\n") == 1


def test_numpy_in_and_out():
    function = low_latency(lambda x, A, s: A @ x + s, np.zeros(2), np.zeros((2, 2)), 0.0, numpy=True)
    A = np.array([[1.0, 2.0], [3.0, 4.0]])
    first = function(np.array([1.0, 1.0]), A, 0.5)
    second = function([0.0, 1.0], A, 0.0)
    assert type(first) is np.ndarray and first.dtype == np.float64
    # The buffer of the second call leaves the first result as it was.
    np.testing.assert_array_equal(first, [3.5, 7.5])
    np.testing.assert_array_equal(second, [2.0, 4.0])
    for x in (np.zeros(3), 0.0, np.zeros((1, 2)), "x"):
        with one_line(r"^argument 1 has .*expected.*\(2,\)"):
            function(x, A, 0.0)
    with one_line("got 2 arguments; expected 3"):
        function(np.zeros(2), A)


def test_results_are_copies_in_the_structure_of_the_function():
    same = low_latency(lambda x: x, np.zeros(64), numpy=True)
    first = same(np.ones(64))
    same(np.zeros(64))  # the buffer is not handed out
    np.testing.assert_array_equal(first, np.ones(64))
    decompose = low_latency(lambda x: Decomposition(x, 2 * x, 3 * x), np.zeros(2), numpy=True)
    parts = decompose([1.0, 2.0])
    assert isinstance(parts, Decomposition) and type(parts.gravity) is np.ndarray
    np.testing.assert_array_equal(parts.gravity, [3.0, 6.0])
    double = low_latency(lambda x: 2 * x, np.zeros(2))
    programs = double._cache_size()
    assert isinstance(double(jnp.ones(2)), jax.Array) and isinstance(double(np.ones(2)), jax.Array)
    assert double._cache_size() == programs  # ready before the loop starts, for NumPy and device arrays alike


def test_examples_are_needed_and_of_one_type():
    with one_line("no example"):
        low_latency(lambda: 0)
    with one_line("types float32, float64"):
        low_latency(lambda x, y: x + y, np.zeros(2, np.float32), np.zeros(2), numpy=True)
