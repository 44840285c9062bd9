"""Every model comes back from its folder as it was, and anything wrong with a folder is refused in one line."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.equations import dynamics
from dln_jax.types import InputError, Needs
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
    "unknown name": (edit("model.json", lambda m: m["model"].update(name="oracle")), "knows structured-delan"),
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
        load(run_folder)
    assert "\n" not in str(caught.value)
