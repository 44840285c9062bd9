"""Options for quick compilation, and, as users compile them, programs that other tests compile without optimisation."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jaxlib import xla_client

from dln_jax import precision

ROOT = Path(__file__).parent.parent


@pytest.mark.as_users_compile
def test_the_compiler_is_at_its_defaults_where_asked(pytestconfig):
    level = xla_client.CompileOptions().executable_build_options.debug_options.xla_backend_optimization_level
    optimised = pytestconfig.getoption("--optimised")
    assert level == (3 if optimised else 0) and bool(precision._OPTIONS) == optimised
    if optimised:
        assert "XLA_FLAGS" not in os.environ and "JAX_DISABLE_MOST_OPTIMIZATIONS" not in os.environ


def test_what_users_run_is_right_as_they_compile_it(pytestconfig):
    if pytestconfig.getoption("--optimised"):
        pytest.skip("with --optimised every test is compiled with default flags, not only these")
    # Options of this run, --slow above all, would select every test.
    environment = {name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "PYTEST_ADDOPTS")}
    command = [sys.executable, "-m", "pytest", "-n", "0", "--optimised", "-m", "as_users_compile"]
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.fixture
def options(monkeypatch):
    """One option that every XLA has, and one that none has."""
    monkeypatch.setattr(precision, "_OPTIONS", {"xla_backend_optimization_level": 1, "xla_cpu_fly": True})
    precision._known.cache_clear()
    yield precision.quick_compilation()
    precision._known.cache_clear()


def test_options_that_xla_does_not_know_are_left_out(options):
    assert options == {"xla_backend_optimization_level": 1}
    assert jax.jit(lambda x: x + 1, compiler_options=options)(jnp.ones(())) == 2
