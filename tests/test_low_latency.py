"""The low-latency mode in processes of its own, callables of NumPy arrays, and artefacts of jax.export."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.deploy import export_stablehlo as stablehlo
from dln_jax.deploy.low_latency import low_latency
from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.dynamics import Decomposition
from dln_jax.scenes.pendulum import pendulum
from dln_jax.types import InputError

EARLY = """
import dln_jax
from dln_jax.deploy.low_latency import enable_low_latency, low_latency
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
from dln_jax.deploy.low_latency import enable_low_latency
from dln_jax.types import InputError
jax.devices()
try:
    enable_low_latency()
except InputError as error:
    assert jax.config.read("jax_cpu_enable_async_dispatch") is True
    print(error)
"""


@pytest.mark.parametrize(("program", "said"), [(EARLY, "fine"), (LATE, "was called after JAX had started its backend")])
def test_the_mode_is_set_before_the_backend_starts_or_refused(program, said):
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=100)
    assert result.returncode == 0, result.stderr
    assert said in result.stdout and result.stdout.count("\n") == 1


def test_numpy_in_and_out():
    function = low_latency(lambda x, A, s: A @ x + s, np.zeros(2), np.zeros((2, 2)), 0.0, numpy=True)
    A = np.array([[1.0, 2.0], [3.0, 4.0]])
    first = function(np.array([1.0, 1.0]), A, 0.5)
    second = function([0.0, 1.0], A, 0.0)
    assert type(first) is np.ndarray and first.dtype == np.float64
    # The buffer of the second call leaves the first result as it was.
    np.testing.assert_array_equal(first, [3.5, 7.5])
    np.testing.assert_array_equal(second, [2.0, 4.0])
    with pytest.raises(ValueError, match="broadcast"):
        function(np.zeros(3), A, 0.0)
    with pytest.raises(ValueError, match="zip"):
        function(np.zeros(2), A)


def test_an_identity_does_not_hand_out_its_buffer():
    same = low_latency(lambda x: x, np.zeros(64), numpy=True)
    first = same(np.ones(64))
    same(np.zeros(64))
    np.testing.assert_array_equal(first, np.ones(64))


def test_results_of_several_arrays_and_device_arrays():
    decompose = low_latency(lambda x: Decomposition(x, 2 * x, 3 * x), np.zeros(2), numpy=True)
    parts = decompose([1.0, 2.0])
    assert isinstance(parts, Decomposition) and type(parts.gravity) is np.ndarray
    np.testing.assert_array_equal(parts.gravity, [3.0, 6.0])
    double = low_latency(lambda x: 2 * x, np.zeros(2))
    programs = double._cache_size()
    assert isinstance(double(jnp.ones(2)), jax.Array) and isinstance(double(np.ones(2)), jax.Array)
    assert double._cache_size() == programs  # ready before the loop starts, for NumPy and device arrays alike


def test_examples_are_needed_and_of_one_type():
    with pytest.raises(InputError, match="no example"):
        low_latency(lambda: 0)
    with pytest.raises(InputError, match="types float32, float64"):
        low_latency(lambda x, y: x + y, np.zeros(2, np.float32), np.zeros(2), numpy=True)


def test_artefacts_give_the_same_results_and_state_what_they_are(tmp_path):
    pytest.importorskip("flatbuffers", reason="jax.export writes artefacts with flatbuffers")
    system = lagrangian.dynamics(pendulum().lagrangian)
    paths = stablehlo.export_dynamics(system, 1, tmp_path / "swing", dtype=jnp.float64)
    assert [path.stem for path in paths] == ["inverse_dynamics", "forward_dynamics", "energy", "mass_matrix"]
    state = np.array([0.3]), np.array([1.2]), np.array([-0.4])
    for path in paths:
        arguments = state[: 3 if "dynamics" in path.stem else 2]
        expected = getattr(system, path.stem)(*map(jnp.asarray, arguments))
        np.testing.assert_allclose(stablehlo.load_stablehlo(path)(*arguments), expected, rtol=1e-14)
        note = json.loads(stablehlo.note_of(path).read_text())
        assert note["jax"] == jax.__version__ and note["platforms"] == ["cpu"] and "six months" in note["reading"]
        assert note["arguments"] == ["float64[1]"] * len(arguments)
    with pytest.raises(InputError, match="exists"):
        stablehlo.export_dynamics(system, 1, tmp_path / "swing", dtype=jnp.float64)
    other = stablehlo.export_stablehlo(
        jnp.sin, np.zeros(2), path=tmp_path / "sin.stablehlo", platforms=["cuda"], overwrite=True
    )
    with pytest.raises(InputError, match="is for cuda, and JAX runs on cpu"):
        stablehlo.load_stablehlo(other)
    other.write_bytes(other.read_bytes()[:40])
    with pytest.raises(InputError, match="no artefact that JAX"):
        stablehlo.load_stablehlo(other)


def test_an_artefact_needs_its_package_and_its_ending(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"does not end in \.stablehlo"):
        stablehlo.export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / "sin.bin")
    with pytest.raises(InputError, match="no such file"):
        stablehlo.load_stablehlo(tmp_path / "void.stablehlo")
    monkeypatch.setattr(stablehlo.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="need the package flatbuffers"):
        stablehlo.export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / "sin.stablehlo")
    assert not list(tmp_path.iterdir())
