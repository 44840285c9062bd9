"""Every model comes back from its folder as it was, and anything wrong with a folder is refused in one line."""

import hashlib
import json
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from calls import json_of, one_line

from dln_jax.mechanics.equations import dynamics
from dln_jax.types import Needs
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import load, save

NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
DESCRIPTION = describe("structured-delan", needs=NEEDS, precision="f32", width=5)


@pytest.fixture
def run_folder(tmp_path):
    save(tmp_path, DESCRIPTION, build(DESCRIPTION).init(jax.random.key(0)))
    return tmp_path


@pytest.mark.slow
def test_a_loaded_run_answers_as_the_model_does(run_folder):
    model = build(DESCRIPTION)
    system = dynamics(model.energies(model.init(jax.random.key(0))))
    loaded = load(run_folder).dynamics
    state = np.array([[0.1, 0.2], [0.3, -1.0], [2.0, 0.5]])
    tau = loaded.inverse_dynamics(*state)
    assert tau.dtype == jnp.float32
    expected = system.inverse_dynamics(*jnp.asarray(state, jnp.float32))
    np.testing.assert_allclose(tau, expected, rtol=1e-5)
    np.testing.assert_allclose(loaded.forward_dynamics(state[0], state[1], tau), state[2], rtol=1e-3)
    np.testing.assert_allclose(loaded.mass_matrix(state[0]), loaded.mass_matrix(state[0], state[1]))
    assert loaded.energy(state[0], state[1]).shape == ()
    assert loaded.decompose(*state).coriolis.shape == (2,)


def edit(name, change):
    def damage(folder):
        path = folder / name
        manifest = json_of(path)
        change(manifest)
        path.write_text(json.dumps(manifest))

    return damage


def truncate(folder):
    path = folder / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-7])


def flip_one_bit(folder):
    path = folder / "model.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


DAMAGES = [
    (truncate, "truncated or altered"),
    (flip_one_bit, "truncated or altered"),
    (lambda folder: (folder / "model.safetensors").unlink(), "missing, though model.json names it"),
    (lambda folder: (folder / "model.json").unlink(), "no such file"),
    (lambda folder: (folder / "model.json").write_text("{"), "not readable as JSON"),
    (edit("model.json", lambda m: m.update(schema_version=99)), "schema version 99"),
    (edit("model.json", lambda m: m.update(tensor_file="../x")), "tensor_file is"),
    (edit("model.json", lambda m: m.pop("model")), "describes no model"),
    (edit("model.json", lambda m: m["model"].update(name="oracle")), "knows structured-delan"),
    (edit("model.json", lambda m: m["model"].pop("width")), "model.json: model description: lacks width; restore"),
    (edit("model.json", lambda m: m["model"].update(width=6)), "expected float32"),
    (edit("model.json", lambda m: m["model"].update(depth=3)), "no tensor|expected float32"),
]


def test_damaged_runs_are_refused_in_one_line(run_folder):
    whole = {path: path.read_bytes() for path in run_folder.iterdir()}
    for act, message in DAMAGES:
        act(run_folder)
        with one_line(message):
            load(run_folder)
        for path, data in whole.items():
            path.write_bytes(data)


LONG = "x" * 5000
OF_MANIFEST = {
    "schema_version": [None, "1", True, 1],
    "tensor_file": [None, 3, ["model.safetensors"], "../model.safetensors", "..", LONG],
    "sha256": [None, [1]],
    "model": [None, "delan", [], {}],
}
OF_DELAN = {
    "name": [["structured-delan"], 3, "os:system", "own"],
    "precision": [["f64"], 64, "f16"],
    "activation": [["tanh"], 1],
    "needs": [[], None, {"joints": {"revolute": 1}}],
    "width": ["3", [3], None, 3.5, True, 0, -3],
    "depth": ["1", 0, 10**9],
    "diagonal_shift": ["2", float("nan")],
    "shared_trunk": ["yes"],
    "colour": [1.0],
}
OF_DIFFNET = {
    "sizes": ["1-3-1", None, [1], ["1", "3", "1"], [1, -3, 1], [1] * 5000],
    "members": ["1", 0],
}
"""Wrong values by key."""


def replaced(stored, wrong):
    return [{**stored, key: value} for key, values in wrong.items() for value in values]


def test_values_that_no_model_has_are_refused_in_one_line(run_folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("diffnet")
    description = describe("differential-network", sizes=[1, 3, 1], activation="cos", members=1, precision="f64")
    save(other, description, build(description).init(jax.random.key(0)))
    for folder, wrong in ((run_folder, OF_DELAN), (other, OF_DIFFNET)):
        manifest = json_of(folder / "model.json")
        described = [{**manifest, "model": model} for model in replaced(manifest["model"], wrong)]
        for stored in [*replaced(manifest, OF_MANIFEST), *described]:
            (folder / "model.json").write_text(json.dumps(stored))
            with one_line() as caught:
                load(folder)
            assert len(str(caught.value)) < 1000 + len(LONG), stored


TENSORS = [
    b"",
    b"no tensors",
    struct.pack("<Q", 2**60) + b"{}",
    struct.pack("<Q", 2) + b"[]",
    # A type that NumPy lacks.
    struct.pack("<Q", 60) + b'{"a":{"dtype":"F8_E4M3","shape":[1],"data_offsets":[0,1]}}'.ljust(60) + b"\0",
    safetensors.numpy.save({"a": np.zeros(3)}),
]


def test_damaged_tensors_are_refused_even_if_the_digest_is_right(run_folder):
    for tensors in TENSORS:
        edit("model.json", lambda m, data=tensors: m.update(sha256=hashlib.sha256(data).hexdigest()))(run_folder)
        (run_folder / "model.safetensors").write_bytes(tensors)
        with one_line("model.safetensors"):
            load(run_folder)
