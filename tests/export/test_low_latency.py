"""The low-latency mode in processes of its own, callables of NumPy arrays, and artefacts of jax.export."""

import hashlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.export import stablehlo
from dln_jax.export.low_latency import low_latency
from dln_jax.mechanics.dynamics import Decomposition
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import pendulum
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import save_tree

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
    for x in (np.zeros(3), np.zeros(1), 0.0, [0.0], np.zeros((1, 2)), "x"):
        with pytest.raises(InputError, match=r"^argument 1 has .*expected.*\(2,\)"):
            function(x, A, 0.0)
    with pytest.raises(InputError, match=r"^argument 3 has shape \(2,\); expected \(\)"):
        function(np.zeros(2), A, np.zeros(2))
    with pytest.raises(InputError, match="got 2 arguments; expected 3"):
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


def test_artefacts_give_the_same_results_also_without_this_package(tmp_path):
    pytest.importorskip("flatbuffers", reason="jax.export writes artefacts with flatbuffers")
    system = dynamics(pendulum().energies)
    paths = stablehlo.export_dynamics(system, 1, tmp_path / "swing", dtype=jnp.float64)
    assert [path.stem for path in paths] == ["inverse_dynamics", "forward_dynamics", "energy", "mass_matrix"]
    state = np.array([0.3]), np.array([1.2]), np.array([-0.4])
    for path in paths:
        arguments = state[: 3 if "dynamics" in path.stem else 2]
        expected = jax.jit(getattr(system, path.stem))(*arguments)
        np.testing.assert_allclose(stablehlo.load_stablehlo(path)(*arguments), expected, rtol=1e-14)
        plain = jax.export.deserialize(bytearray(path.read_bytes()))  # as without this package
        assert plain.platforms == ("cpu",) and {str(shape) for shape in plain.in_avals} == {"float64[1]"}
    loaded = stablehlo.load_stablehlo(paths[-1])
    np.testing.assert_allclose(loaded(*map(list, state[:2])), expected, rtol=1e-14)
    np.testing.assert_allclose(plain.call(*state[:2]), expected, rtol=1e-14)
    with pytest.raises(InputError, match=r"argument 2 has shape \(1, 1\); expected \(1,\)"):
        loaded(state[0], state[1][None])
    with pytest.raises(InputError, match="already"):
        stablehlo.export_dynamics(system, 1, tmp_path / "swing", dtype=jnp.float64)
    other = stablehlo.export_stablehlo(
        jnp.sin, np.zeros(2), path=tmp_path / "sin.stablehlo", platforms=["cuda"], overwrite=True
    )
    with pytest.raises(InputError, match="is for cuda, and JAX runs on cpu"):
        stablehlo.load_stablehlo(other)


@pytest.fixture
def doubled(tmp_path):
    """An artefact of (float64[2], float64) -> float64[2], alone in its folder."""
    pytest.importorskip("flatbuffers", reason="jax.export writes artefacts with flatbuffers")
    return stablehlo.export_stablehlo(lambda x, s: x * s, np.zeros(2), 1.0, path=tmp_path / "a" / "double.stablehlo")


def write_digest(path):
    path.write_bytes(b"no artefact" + hashlib.sha256(b"no artefact").digest())


def change_byte(path):
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)


DAMAGED = {
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-5]), r"double\.stablehlo: truncated or altered"),
    "altered": (change_byte, r"double\.stablehlo: truncated or altered"),
    "empty": (lambda path: path.write_bytes(b""), r"double\.stablehlo: truncated or altered"),
    "no artefact": (write_digest, "no artefact that JAX"),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_artefacts_are_refused(doubled, damage):
    function, message = DAMAGED[damage]
    function(doubled)
    with pytest.raises(InputError, match=message):
        stablehlo.load_stablehlo(doubled)


def test_arguments_of_another_shape_or_type_are_refused(doubled):
    double = stablehlo.load_stablehlo(doubled)
    np.testing.assert_array_equal(double(np.ones(2), 2.0), [2.0, 2.0])
    for same in (np.ones(2, np.float32), [1, 1]):
        np.testing.assert_array_equal(double(same, 2), [2.0, 2.0])
    for wrong in (np.ones(3), np.ones((5, 2)), [1.0]):
        with pytest.raises(InputError, match=r"^argument 1 has shape .*; expected \(2,\)"):
            double(wrong, 2.0)
    with pytest.raises(InputError, match=r"double.stablehlo takes \(float64\[2\], float64\[\]\), got 1 arg"):
        double(np.ones(2))


def test_refused_exports_write_nothing(doubled, tmp_path):
    system = dynamics(pendulum().energies)
    place = doubled.parent
    for wrong in ({"platforms": "cpu"}, {"platforms": ("tpux",)}, {"platforms": ()}):
        with pytest.raises(InputError, match="platforms is"):
            stablehlo.export_dynamics(system, 1, tmp_path / "b", dtype=jnp.float64, **wrong)
    for d in (0, -1, True):
        with pytest.raises(InputError, match="degrees_of_freedom is"):
            stablehlo.export_dynamics(system, d, tmp_path / "b", dtype=jnp.float64)
    for example in ([1.0], "a", None, np.array(["a"])):
        with pytest.raises(InputError, match="example 1 is"):
            stablehlo.export_stablehlo(jnp.sin, example, path=tmp_path / "b" / "sin.stablehlo")
    with jax.enable_x64(False), pytest.raises(InputError, match="needs double precision"):
        stablehlo.export_dynamics(system, 1, tmp_path / "b", dtype=jnp.float64)
    assert not (tmp_path / "b").exists()
    # One of four artefacts is there already: none is written.
    doubled.rename(place / "energy.stablehlo")
    with pytest.raises(InputError, match=r"holds energy\.stablehlo already"):
        stablehlo.export_dynamics(system, 1, place, dtype=jnp.float64)
    with pytest.raises(InputError, match="cannot write there"):
        stablehlo.export_dynamics(system, 1, place / "energy.stablehlo", dtype=jnp.float64)
    with pytest.raises(InputError, match="no such file"):
        stablehlo.load_stablehlo(place)
    assert {path.name for path in place.iterdir()} == {"energy.stablehlo"}


def test_an_artefact_never_takes_the_place_of_a_runs_file(tmp_path):
    pytest.importorskip("flatbuffers", reason="jax.export writes artefacts with flatbuffers")
    save_tree(tmp_path, "model", {"w": np.ones(2)}, {})
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for name in ("model", "config", "inverse"):
        with pytest.raises(InputError, match="is the folder of a run"):
            stablehlo.export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / f"{name}.stablehlo", overwrite=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_an_artefact_needs_its_package_and_its_ending(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"does not end in \.stablehlo"):
        stablehlo.export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / "sin.bin")
    with pytest.raises(InputError, match="no such file"):
        stablehlo.load_stablehlo(tmp_path / "void.stablehlo")
    monkeypatch.setattr(stablehlo.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="need the package flatbuffers"):
        stablehlo.export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / "sin.stablehlo")
    assert not list(tmp_path.iterdir())
