"""Stored trees come back bit for bit, and anything wrong with them is refused in one line."""

import json
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.equations import dynamics
from dln_jax.types import InputError
from dln_jax.zoo.kinds import build
from dln_jax.zoo.load import load_run, save_model
from dln_jax.zoo.parameter_files import load_manifest, load_tree, save_tree

DESCRIPTION = {
    "kind": "structured-delan",
    "needs": {"joints": ["revolute", "prismatic"], "gravity": True, "friction": True, "actuation": None},
    "width": 5,
    "depth": 2,
    "activation": "tanh",
    "diagonal_shift": 2.0,
    "diagonal_floor": 0.1,
    "precision": "f32",
}


class State(NamedTuple):
    layers: dict
    count: jax.Array
    done: jax.Array


TREE = State(
    {"a/b": {"w": jnp.arange(6.0).reshape(2, 3), "e": jnp.ones((), jnp.float32) / 3}},
    jnp.int32(7),
    jnp.array(True),
)


def test_a_tree_comes_back_bit_for_bit_and_old_states_are_removed(tmp_path):
    for number in (1, 2):
        save_tree(tmp_path, "checkpoint", TREE, {"note": number}, number=number)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoint-000000002.safetensors", "checkpoint.json"]
    manifest = load_manifest(tmp_path, "checkpoint")
    assert manifest["note"] == 2 and set(manifest["versions"]) >= {"jax", "dln-jax"}
    assert manifest["tensors"]["count"] == {"shape": [], "dtype": "int32"}
    again = load_tree(tmp_path, "checkpoint", TREE)
    assert isinstance(again, State)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(TREE), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.fixture
def run_folder(tmp_path):
    save_model(tmp_path, DESCRIPTION, build(DESCRIPTION).init(jax.random.key(0)))
    return tmp_path


def test_a_loaded_run_answers_as_the_model_does(run_folder):
    model = build(DESCRIPTION)
    system = dynamics(model.energies(model.init(jax.random.key(0))))
    loaded = load_run(run_folder)
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
        manifest = json.loads(path.read_text())
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


DAMAGES = {
    "truncated": (truncate, "truncated or altered"),
    "one bit": (flip_one_bit, "truncated or altered"),
    "no tensors": (lambda folder: (folder / "model.safetensors").unlink(), "missing, though model.json names it"),
    "no manifest": (lambda folder: (folder / "model.json").unlink(), "no such file"),
    "no json": (lambda folder: (folder / "model.json").write_text("{"), "not readable as JSON"),
    "future schema": (edit("model.json", lambda m: m.update(schema_version=99)), "schema version 99"),
    "foreign path": (edit("model.json", lambda m: m.update(tensor_file="../x")), "tensor_file is"),
    "no description": (edit("model.json", lambda m: m.pop("model")), "describes no model"),
    "unknown kind": (edit("model.json", lambda m: m["model"].update(kind="oracle")), "knows structured-delan"),
    "other width": (edit("model.json", lambda m: m["model"].update(width=6)), "expected float32"),
    "other depth": (edit("model.json", lambda m: m["model"].update(depth=3)), "no tensor|expected float32"),
    "unknown setting": (edit("model.json", lambda m: m["model"].update(colour="red")), "colour"),
    "missing setting": (edit("model.json", lambda m: m["model"].pop("needs")), "needs"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_refused_in_one_line(run_folder, damage):
    act, message = DAMAGES[damage]
    act(run_folder)
    with pytest.raises(InputError, match=message) as caught:
        load_run(run_folder)
    assert "\n" not in str(caught.value)
