"""A library user's mistakes are one clear `InputError`, and nothing is written or overwritten by them."""

import copy
import pickle
import tracemalloc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dln_jax
from dln_jax import errors
from dln_jax.data import schema
from dln_jax.errors import memory, require_memory, require_network
from dln_jax.learning.engine.fit import newton_stages
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Problem, sharing
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.models.hamiltonian import make_black_box_hamiltonian
from dln_jax.scenes.datasets.generators import uniform
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.terms.loads import gravity
from dln_jax.types import InputError, Needs

ARM = Needs(joints=("revolute", "prismatic"))
DESCRIPTION = dln_jax.describe("structured-delan", needs=ARM, precision="f64", width=3, depth=1)
PARAMETERS = jax.tree.map(
    lambda leaf: np.ones(leaf.shape), jax.eval_shape(dln_jax.build(DESCRIPTION).init, jax.random.key(0))
)
GOOD = schema.from_arrays(
    {
        "t": np.tile(np.arange(4.0), 2),
        **{key: np.random.default_rng(0).normal(size=(8, 2)) for key in ("q", "qd", "qdd", "tau")},
        "trajectory": np.repeat(np.arange(2), 4),
    }
)


def test_needs_of_unknown_kinds_are_refused():
    for fields in [
        {"joints": "revolute"},
        {"joints": ("ball",)},
        {"joints": ()},
        {"joints": 3},
        {"joints": ("revolute",), "gravity": 1},
        {"joints": ("revolute",), "joint_friction": ("sticky",)},
        {"joints": ("revolute",), "joint_friction": "viscous"},
    ]:
        with pytest.raises(InputError, match="expected"):
            Needs(**fields)
        with pytest.raises(InputError, match="expected"):
            ARM._replace(**fields)


def test_needs_stay_what_they_were_through_copies():
    assert Needs(joints=["revolute"]) == Needs(joints=("revolute",))
    for same in (copy.deepcopy(ARM), pickle.loads(pickle.dumps(ARM)), Needs(**ARM._asdict())):
        assert same == ARM and hash(same) == hash(ARM) and type(same) is Needs


def test_a_model_is_not_saved_over_another_unasked(tmp_path):
    dln_jax.save(tmp_path, DESCRIPTION, PARAMETERS)
    before = (tmp_path / "model.json").read_bytes()
    with pytest.raises(InputError, match="overwrite=True"):
        dln_jax.save(tmp_path, DESCRIPTION, PARAMETERS)
    assert (tmp_path / "model.json").read_bytes() == before
    dln_jax.save(tmp_path, DESCRIPTION, jax.tree.map(lambda leaf: leaf + 1, PARAMETERS), overwrite=True)
    assert (tmp_path / "model.json").read_bytes() != before
    with pytest.raises(InputError, match="no such folder"):
        dln_jax.save(tmp_path / "nowhere", DESCRIPTION, PARAMETERS)


def test_parameters_of_another_model_are_not_saved(tmp_path):
    wider = jax.tree.map(lambda leaf: np.ones([size + 1 for size in leaf.shape]), PARAMETERS)
    single = jax.tree.map(lambda leaf: leaf.astype(np.float32), PARAMETERS)
    words = jax.tree.map(lambda leaf: "many", PARAMETERS)
    for wrong in ({}, {"w": np.zeros(3)}, wider, single, words, {**PARAMETERS, "more": np.zeros(3)}, np.zeros(3)):
        with pytest.raises(InputError, match="parameter"):
            dln_jax.save(tmp_path, DESCRIPTION, wrong)
    assert not list(tmp_path.iterdir())


WRONG_DATA = [
    {"q": np.full((8, 2), np.nan)},
    {"label": np.array([None, None])},
    {"needs": Needs(joints=("revolute",))},
    {"tau": np.full((8, 2), 1e154)},
    {"tau": np.full((8, 2), 1e-200)},
]


def test_trajectories_that_load_would_refuse_are_not_saved_nor_written_through_links(tmp_path):
    path = tmp_path / "data.npz"
    for changes in WRONG_DATA:
        with pytest.raises(InputError, match="is not written"):
            schema.save(path, GOOD._replace(**changes))
    assert not list(tmp_path.iterdir())
    path.symlink_to("nowhere.npz")
    with pytest.raises(InputError, match="exists"):
        schema.save(path, GOOD)


def test_names_of_precisions_and_activations_are_checked():
    with pytest.raises(InputError, match="f32 or f64"):
        dln_jax.describe("structured-delan", needs=ARM, precision="f16")
    assert jax.eval_shape(dln_jax.make_delan(ARM, activation="silu").init, jax.random.key(0))
    for make in (dln_jax.make_delan, make_black_box_hamiltonian):
        with pytest.raises(InputError, match="choose one of"):
            make(ARM, activation="tangent")
        for wrong in ({"width": 10**9}, {"depth": 10**9}, {"width": 0}):
            with pytest.raises(InputError, match="expected"):
                make(ARM, **wrong)


def systems():
    yield dln_jax.build(DESCRIPTION).energies(PARAMETERS)
    yield dln_jax.NaturalSystem(lambda q: jnp.diag(jnp.asarray([1.0, 2.0], q.dtype)))


def test_states_of_another_size_than_the_system_are_refused():
    """Also where JAX would read the last element in place of one that is missing."""
    for system in systems():
        functions = dln_jax.dynamics(system)
        for function in map(jax.jit, (functions.inverse_dynamics, functions.forward_dynamics)):
            assert np.isfinite(function(*[jnp.ones(2)] * 3)).all()
            for size in (1, 3):
                with pytest.raises(InputError, match=r"size|shape"):
                    function(*[jnp.ones(size)] * 3)


def test_an_array_of_words_is_refused():
    with pytest.raises(InputError, match=r"inertias .*expected real numbers"):
        make_tree((-1,), ("revolute",), np.eye(3)[None], np.zeros((1, 3)), np.eye(3)[:1], "heavy")


def test_a_parameter_of_a_scene_that_is_no_number_is_refused():
    mesh = beam(1.0, 1.0, 1, 1)
    params = make_scene(mesh, [gravity(mesh)]).params
    for wrong in ("down", [None, 1.0]):
        with pytest.raises(InputError, match=r"acceleration is .*; expected numbers"):
            with_parameters(params, gravity={"acceleration": wrong})


def test_more_memory_than_there_is_is_refused_with_both_numbers():
    require_memory("little", 1e6)
    with pytest.raises(InputError, match=r"much would need about .* GiB of memory, but this machine has .* GiB"):
        require_memory("much", 2 * min(memory(), 1e18))
    with pytest.raises(InputError, match="elements"):
        beam(1.0, 1.0, 100_000, 100_000)


def equations_of(parameters):
    """Gauss-Newton's stages for so many parameters."""
    score = lambda theta: (jnp.sum(theta), jnp.nan)  # noqa: E731
    problem = Problem(lambda theta, x: theta[:1] * x, jnp.zeros(parameters), (jnp.ones((4, 1)),), score)
    return newton_stages(problem, GaussNewton(steps=1), sharing(problem, None))


AT_THE_LIMIT = {  # what is asked for, and the bytes that it is estimated to take
    "equations": (lambda: equations_of(3_000), 24 * 3_000**2),
    "mesh": (lambda: box((1.0, 1.0, 1.0), (12, 12, 12)), 4096 * 5 * 12**3),
    "samples": (lambda: uniform(two_link_arm(), samples=100_000, seed=0), 160 * 100_000 * 2),
    "network": (lambda: require_network(width=3_000, depth=3), 32 * 3_000**2 * 2),
}


@pytest.mark.parametrize("asked, estimate", AT_THE_LIMIT.values(), ids=AT_THE_LIMIT)
def test_what_does_not_fit_is_refused_before_it_is_allocated(asked, estimate, monkeypatch):
    monkeypatch.setattr(errors, "memory", lambda: estimate - 1.0)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=r"would need about .* GiB of memory.*ask for less") as caught:
            asked()
        assert tracemalloc.get_traced_memory()[1] < estimate / 5
    finally:
        tracemalloc.stop()
    assert "\n" not in str(caught.value)
    # One byte more is enough: what is made is what was estimated for.
    monkeypatch.setattr(errors, "memory", lambda: float(estimate))
    asked()
