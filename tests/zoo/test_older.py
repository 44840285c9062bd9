"""Folders of release 0.1.0 (schema version 1) load as they were, by a table that no factory's default can change."""

import hashlib
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from dln_jax.types import InputError, Needs
from dln_jax.zoo import older
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import load

SWING = {"joints": ["revolute"], "gravity": True, "friction": True, "actuation": None}
FREE = {**SWING, "friction": False}
BODIES = {"joints": ["prismatic", "prismatic", "prismatic", "prismatic"], "gravity": True, "friction": False}
SIZE = {"precision": "f64", "width": 3, "depth": 1, "activation": "tanh"}
# As that release wrote them, beside the kind.
WRITTEN = {
    "structured-delan": {"needs": SWING, **SIZE, "activation": "silu"},
    "black-box-delan": {"needs": SWING, **SIZE, "rate_scale": [1.5]},
    "trigonometric": {"needs": SWING, "precision": "f64", "degree": [2]},
    "feed-forward": {
        **{"needs": FREE, **SIZE, "precision": "f32"},
        **{"rate_scale": [1.5], "acceleration_scale": [8.0], "tau_scale": [0.5]},
    },
    "structured-hnn": {"needs": SWING, **SIZE},
    "black-box-hnn": {"needs": FREE, **SIZE, "momentum_scale": [0.7]},
    "separable-hamiltonian": {"needs": SWING, **SIZE, "friction_width": 4, "momentum_scale": 0.7},
    "structured-hamiltonian": {"needs": SWING, **SIZE, "friction_width": 4},
    "black-box-hamiltonian": {"needs": SWING, **SIZE, "momentum_scale": 0.7},
    "pairwise-hamiltonian": {"needs": BODIES, **SIZE},
    "polynomial-hamiltonian": {"needs": FREE, "precision": "f64", "degree": 3},
    "phase-network": {"needs": FREE, **SIZE, "momentum_scale": 0.7, "rate_scale": 1.5},
    "differential-mlp": {"sizes": [2, 3, 1], "activation": "cos", "members": 1, "precision": "f64"},
    "latent-phase": {"field": "hnn", "components": 2, "pixels": 6, "precision": "f32"},
}
NETWORK = {"{}/~/linear_0/b": (3,), "{}/~/linear_0/w": (2, 3), "{}/~/linear_1/b": (1,), "{}/~/linear_1/w": (3, 1)}


def tensors_of(name, shapes=NETWORK, prefix=""):
    return {prefix + key.format(name): shape for key, shape in shapes.items()}


WIDER = {"{}/~/linear_0/b": (3,), "{}/~/linear_0/w": (3, 3), "{}/~/linear_1/b": (1,), "{}/~/linear_1/w": (3, 1)}
STRUCTURED = {**tensors_of("cholesky"), **tensors_of("potential")}
FRICTION = {"~/viscous_friction": (1,)}
BENT = {
    "friction/friction/~/linear_0/b": (4,),
    "friction/friction/~/linear_0/w": (2, 4),
    "friction/friction/~/linear_1/b": (1,),
    "friction/friction/~/linear_1/w": (4, 1),
}
TENSORS = {
    "structured-delan": {**STRUCTURED, **FRICTION},
    "black-box-delan": {**tensors_of("lagrangian", WIDER), **FRICTION},
    "trigonometric": {"mass": (1, 5), "potential": (4,), "friction": (1,)},
    "feed-forward": {
        **tensors_of("inverse", {**WIDER, "{}/~/linear_0/w": (4, 3)}),
        **tensors_of("forward", {**WIDER, "{}/~/linear_0/w": (4, 3)}),
    },
    "structured-hnn": {**STRUCTURED, **FRICTION},
    "black-box-hnn": tensors_of("hamiltonian", WIDER),
    "separable-hamiltonian": {
        **tensors_of("kinetic", {**NETWORK, "{}/~/linear_0/w": (1, 3)}, "energy/"),
        **tensors_of("potential", NETWORK, "energy/"),
        **BENT,
    },
    "structured-hamiltonian": {
        **tensors_of("cholesky", NETWORK, "energy/"),
        **tensors_of("potential", NETWORK, "energy/"),
        **BENT,
    },
    "black-box-hamiltonian": {**tensors_of("hamiltonian", WIDER), **FRICTION},
    "pairwise-hamiltonian": {
        **tensors_of("pair", {**NETWORK, "{}/~/linear_0/w": (3, 3)}),
        "pair_linear/w": (3, 1),
        "~/log_mass": (1,),
    },
    "polynomial-hamiltonian": {"": (15,)},
    "phase-network": tensors_of("rates", {**WIDER, "{}/~/linear_1/b": (2,), "{}/~/linear_1/w": (3, 2)}),
    "differential-mlp": {"0/0": (1, 2, 3), "0/1": (1, 3), "1/0": (1, 3, 1), "1/1": (1, 1)},
}
"""Names and shapes of the arrays that it wrote."""


def write(folder, kind):
    """A folder of release 0.1.0: the manifest in its own words, and arrays under its own names."""
    description = {"kind": kind, **WRITTEN[kind]}
    draw = np.random.default_rng(0).normal
    dtype = np.float32 if description["precision"] == "f32" else np.float64
    tensors = {key: 0.3 * draw(size=shape).astype(dtype) for key, shape in TENSORS[kind].items()}
    store(folder, description, tensors)
    return tensors


def store(folder, description, tensors):
    data = safetensors.numpy.save(tensors)
    (folder / "model.safetensors").write_bytes(data)
    manifest = {
        "schema_version": 1,
        "tensor_file": "model.safetensors",
        "sha256": hashlib.sha256(data).hexdigest(),
        "tensors": {key: {"shape": list(array.shape), "dtype": str(array.dtype)} for key, array in tensors.items()},
        "versions": {"dln-jax": "0.1.0", "jax": "0.10.2", "dm-haiku": "0.0.17"},
        "model": description,
    }
    (folder / "model.json").write_text(json.dumps(manifest))


def test_every_old_kind_is_tried():
    assert set(WRITTEN) == set(older.KINDS)


@pytest.mark.parametrize("kind", TENSORS)
def test_an_old_folder_loads_under_its_new_name(kind, tmp_path):
    tensors = write(tmp_path, kind)
    run = load(tmp_path)
    name, defaults = older.KINDS[kind]
    written = WRITTEN[kind]
    needs = {"needs": {"actuation": None, **written["needs"]}} if "needs" in written else {}
    assert run.description == {"name": name, **defaults, **written, **needs}
    assert sum(leaf.size for leaf in jax.tree.leaves(run.parameters)) == sum(a.size for a in tensors.values())
    if kind == "differential-mlp":
        assert np.isfinite(run.derivatives([0.1, 0.2]).hessian).all()
    elif kind in ("feed-forward", "trigonometric", "black-box-delan"):
        assert np.isfinite(run.dynamics.inverse_dynamics([0.3], [0.1], [1.0])).all()
    else:
        q = np.linspace(0.1, 0.8, len(WRITTEN[kind]["needs"]["joints"]))
        assert np.isfinite(jnp.stack(run.flow.rates(q**2, q))).all()


def test_what_was_left_out_is_what_it_was(tmp_path):
    """The torque of the closed form, with the floor and the shift of 0.1.0."""
    tensors = write(tmp_path, "structured-delan")
    q = 0.3
    x = np.array([np.cos(q), np.sin(q)])
    a = x @ tensors["cholesky/~/linear_0/w"] + tensors["cholesky/~/linear_0/b"]
    entry = (a / (1 + np.exp(-a))) @ tensors["cholesky/~/linear_1/w"] + tensors["cholesky/~/linear_1/b"]
    factor = np.log1p(np.exp(entry[0] + 2.0)) + 0.1
    np.testing.assert_allclose(load(tmp_path).dynamics.mass_matrix([q]), [[factor**2]], rtol=1e-12)


def test_an_old_model_of_pictures_loads(tmp_path):
    """Its components were stored in double precision, and its networks in single."""
    description = describe("latent-phase", field="black-box-hnn", pixels=6, components=2, precision="f32")
    shapes = jax.eval_shape(build(description).init, jax.random.key(0))
    draw = np.random.default_rng(0).normal
    leaves = jax.tree_util.tree_flatten_with_path(shapes["parameters"])[0]
    names = ["parameters/" + jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves]
    tensors = {
        name: 0.3 * draw(size=leaf.shape).astype(np.float32) for name, (_, leaf) in zip(names, leaves, strict=True)
    }
    tensors |= {
        "components/mean": draw(size=6),
        "components/basis": draw(size=(2, 6)),
        "components/scale": np.array(1.5),
    }
    store(tmp_path, {"kind": "latent-phase", **WRITTEN["latent-phase"]}, tensors)
    run = load(tmp_path)
    assert run.description == description
    np.testing.assert_array_equal(run.parameters["components"]["basis"], tensors["components/basis"].astype(np.float32))
    q, p = run.pictures.encode(np.linspace(0, 1, 12))
    assert np.isfinite(run.pictures.decode(q, p)).all() and np.isfinite(run.pictures.field.energy(q, p))


def test_today_the_defaults_are_those_of_then():
    """Not that they had to be: whoever changes a default changes this test, and no table."""
    for kind, (name, defaults) in older.KINDS.items():
        needs = Needs(joints=("prismatic",) * 4) if name == "pairwise-hnn" else Needs(joints=("revolute",))
        required = {
            "differential-network": {"sizes": [1, 1], "activation": "tanh", "members": 1},
            "latent-phase": {"field": "phase-network", "pixels": 6, "components": 2},
        }
        today = describe(name, precision="f64", **required.get(name, {"needs": needs}))
        assert {key: today[key] for key in defaults} == defaults, kind


@pytest.mark.parametrize("kind", ["oracle", "differential-network", None, 3, ["structured-delan"]])
def test_what_that_release_did_not_know_is_refused(kind, tmp_path):
    store(tmp_path, {**WRITTEN["trigonometric"], "kind": kind}, {})
    with pytest.raises(InputError, match=r"model kind is .*; release 0\.1\.0 knew structured-delan, ") as caught:
        load(tmp_path)
    assert "\n" not in str(caught.value) and "model.json" in str(caught.value)


def test_an_old_folder_that_lacks_what_it_always_had_is_refused(tmp_path):
    write(tmp_path, "phase-network")
    path = tmp_path / "model.json"
    manifest = json.loads(path.read_text())
    manifest["model"].pop("activation")
    path.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="lacks activation"):
        load(tmp_path)
