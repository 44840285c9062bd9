"""Recursions over trees equal derivatives of their energies, closed forms of textbook scenes, and laws of mechanics."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import slow_among

from dln_jax.mechanics import jacobians
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.integrators import looped_rk4, rollout, second_order
from dln_jax.mechanics.trees import (
    Tree,
    dh_frames,
    inertial_parameters,
    kinetic_energy,
    make_tree,
    moved,
    newton_euler,
    potential_energy,
    pseudo_inertia,
    regressor,
    serial,
    tree_energies,
    tree_system,
    with_payload,
    world_frames,
)
from dln_jax.scenes import chain
from dln_jax.types import InputError


def rotation(random):
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def body(random):
    """That exists: moments of a cloud of points."""
    points, mass = random.normal(size=(6, 3)) * 0.2, random.uniform(0.5, 3)
    spread = np.cov(points.T, bias=True)
    return inertial_parameters(mass, points.mean(0), mass * (np.trace(spread) * np.eye(3) - spread))


def random_tree(seed, d=3, *, branched=True, kinds=("revolute", "prismatic"), axes=None):
    random = np.random.default_rng(seed)
    parents = [int(random.integers(-1, link)) if branched else link - 1 for link in range(d)]
    return make_tree(
        parents,
        [kinds[int(random.random() < 0.3) % len(kinds)] for _ in range(d)],
        [rotation(random) for _ in range(d)],
        random.normal(size=(d, 3)) * 0.4,
        random.normal(size=(d, 3)) if axes is None else np.eye(3)[[axes] * d],
        [body(random) for _ in range(d)],
        armature=random.uniform(0, 0.3, d),
        gravity=(1.0, -2.0, -9.0),
    )


TREES = {
    "branched": random_tree(7, d=3),
    "about x": random_tree(4, d=2, axes=0),
    "arm": random_tree(2, d=2, branched=False, kinds=("revolute",), axes=2),
    "from prismatic joints": random_tree(0, d=2, branched=False, kinds=("prismatic", "revolute")),
    "one weightless joint": random_tree(4, d=1)._replace(gravity=np.zeros(3)),
}


class Case(NamedTuple):
    tree: Tree
    state: tuple[np.ndarray, ...]
    tau: np.ndarray
    """By derivatives of the Lagrangian."""
    mass_matrix: np.ndarray
    energy: np.ndarray


@pytest.fixture(scope="module", params=slow_among(TREES, ("about x", "arm").__contains__))
def case(request):
    tree = TREES[request.param]
    state = tuple(np.random.default_rng(9).normal(size=(3, tree.degrees_of_freedom)))
    slow = dynamics(tree_energies(tree))
    answers = jax.jit(lambda q, qd, qdd: (slow.inverse_dynamics(q, qd, qdd), slow.mass_matrix(q), slow.energy(q, qd)))
    return Case(tree, state, *map(np.asarray, answers(*state)))


def test_recursions_equal_derivatives_of_the_energies(case):
    fast = dynamics(tree_system(case.tree))
    q, qd, qdd = case.state

    @jax.jit
    def answers(q, qd, qdd):
        tau = fast.inverse_dynamics(q, qd, qdd)
        return tau, fast.mass_matrix(q), fast.energy(q, qd), fast.forward_dynamics(q, qd, tau)

    tau, mass, energy, acceleration = answers(q, qd, qdd)
    np.testing.assert_allclose(tau, case.tau, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(mass, case.mass_matrix, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(energy, case.energy, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(acceleration, qdd, rtol=1e-10, atol=1e-10)


def test_forces_are_linear_in_the_parameters(case):
    phi = jax.jit(lambda *state: regressor(case.tree, *state))(*case.state)
    theta = np.concatenate([case.tree.inertias.ravel(), case.tree.armature])
    assert phi.shape == (len(case.tree.parents), theta.size)
    np.testing.assert_allclose(phi @ theta, case.tau, rtol=1e-12, atol=1e-12)


def test_jacobians_equal_those_of_the_generic_way():
    tree = TREES["from prismatic joints"]
    state = np.random.default_rng(9).normal(size=(3, tree.degrees_of_freedom))
    ours = jax.jit(lambda *state: jacobians.inverse_dynamics_jacobians(tree_system(tree), *state))(*state)
    theirs = jax.jit(jax.jacfwd(lambda *state: newton_euler(tree, *state), argnums=(0, 1, 2)))(*state)
    for got, expected in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


def test_learned_numbers_give_what_known_ones_give():
    """Learned numbers are JAX arrays or traced, and nothing is known to be zero."""
    tree = TREES["arm"]
    state = np.random.default_rng(9).normal(size=(3, tree.degrees_of_freedom))

    def forces(numbers):
        learned = tree._replace(**dict(zip(("rotations", "positions", "inertias", "armature"), numbers, strict=True)))
        return newton_euler(learned, *map(jnp.asarray, state))

    numbers = tuple(map(jnp.asarray, (tree.rotations, tree.positions, tree.inertias, tree.armature)))
    np.testing.assert_allclose(jax.jit(forces)(numbers), newton_euler(tree, *map(jnp.asarray, state)), rtol=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(jax.jit(jax.jacrev(forces))(numbers)))


def test_potential_is_that_of_the_centres_of_mass(case):
    tree, q = case.tree, case.state[0]
    rotations, origins = world_frames(tree, jnp.asarray(q))
    moments = tree.inertias[:, :1] * origins + jnp.einsum("lij,lj->li", rotations, tree.inertias[:, 1:4])
    assert float(potential_energy(tree, jnp.asarray(q))) == pytest.approx(
        -float(tree.gravity @ moments.sum(0)), abs=1e-12
    )


def test_energy_is_conserved():
    tree = TREES["arm"]
    motion = dynamics(tree_system(tree))
    start = jnp.array([-0.5, 0.5]), jnp.array([1.0, -1.0])
    field = second_order(lambda t, q, qd: motion.forward_dynamics(q, qd, jnp.zeros(2)))
    q, qd = jax.jit(lambda start: rollout(looped_rk4(field), start, np.linspace(0, 0.2, 5), substeps=20))(start)
    energy, kinetic = jax.jit(jax.vmap(lambda q, qd: (motion.energy(q, qd), kinetic_energy(tree, q, qd))))(q, qd)
    scale = float(kinetic.max())
    assert np.abs(energy - energy[0]).max() < 1e-7 * scale


def test_hamiltons_equations_hold():
    tree = TREES["about x"]
    system, motion = tree_system(tree), dynamics(tree_system(tree))
    q, qd = np.random.default_rng(3).normal(size=(2, 2))
    p = np.asarray(motion.mass_matrix(q)) @ qd
    rates = jax.jit(flow(system).rates)(q, p)
    np.testing.assert_allclose(rates[0], qd, rtol=1e-9, atol=1e-9)


def test_a_planar_tree_is_the_textbook_chain():
    """Rods of length 1 and mass 1 that hang along -y and turn about z."""
    d = 2
    rod = inertial_parameters(1.0, [0, -0.5, 0], np.diag([1 / 12, 0, 1 / 12]))
    positions = [[0, 0, 0]] + [[0, -1.0, 0]] * (d - 1)
    tree = serial([np.eye(3)] * d, positions, [rod] * d, gravity=(0, -9.81, 0))
    ours, textbook = dynamics(tree_system(tree)), dynamics(chain(d).closed_form)
    q, qd, qdd = np.random.default_rng(5).normal(size=(3, d))
    np.testing.assert_allclose(ours.inverse_dynamics(q, qd, qdd), textbook.inverse_dynamics(q, qd, qdd), rtol=1e-12)
    np.testing.assert_allclose(ours.mass_matrix(q), textbook.mass_matrix(q), rtol=1e-12)


def test_a_payload_is_a_body_more():
    tree, random = TREES["arm"], np.random.default_rng(8)
    payload, turn, place = body(random), rotation(random), random.normal(size=3)
    loaded = with_payload(tree, 1, payload, rotation=turn, position=place)
    fixed = make_tree(
        (*tree.parents, 1), (*tree.joints, "revolute"), [*tree.rotations, turn], [*tree.positions, place],
        [*tree.axes, [0, 0, 1]], [*tree.inertias, payload], armature=[*tree.armature, 0], gravity=tree.gravity,
    )  # fmt: skip
    q, qd, qdd = random.normal(size=(3, 2))
    still = [np.append(vector, 0.0) for vector in (q, qd, qdd)]
    expected = jax.jit(dynamics(tree_system(fixed)).inverse_dynamics)(*still)[:2]
    tau = jax.jit(dynamics(tree_system(loaded)).inverse_dynamics)(q, qd, qdd)
    np.testing.assert_allclose(tau, expected, rtol=1e-12)


def test_bodies_that_exist_have_definite_pseudo_inertias():
    random = np.random.default_rng(7)
    theta = body(random)
    there = moved(theta, rotation(random), random.normal(size=3))
    assert np.linalg.eigvalsh(pseudo_inertia(theta)).min() > 0
    assert np.linalg.eigvalsh(pseudo_inertia(there)).min() > 0
    negative = inertial_parameters(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0]))  # breaks the triangle inequality
    assert np.linalg.eigvalsh(pseudo_inertia(negative)).min() < 0


def test_denavit_hartenberg_rows():
    rotations, positions = dh_frames([[0, 0, 0.333, 0], [-np.pi / 2, 0, 0, 0], [np.pi / 2, 0.0825, 0.316, 0.3]])
    np.testing.assert_allclose(positions[0], [0, 0, 0.333])
    np.testing.assert_array_equal(rotations[1], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(positions[2], [0.0825, -0.316, 0], atol=1e-15)


REFUSED = {
    "order": ({"parents": (0, -1)}, "parents are"),
    "kind": ({"joints": ("revolute", "ball")}, "joints are"),
    "shape": ({"inertias": np.ones((2, 9))}, r"inertias has shape \(2, 9\); expected \(2, 10\)"),
    "not finite": ({"positions": np.full((2, 3), np.nan)}, "positions has nan at"),
    "no rotation": ({"rotations": [np.eye(3), -np.eye(3)]}, "rotations has a matrix that is not a rotation"),
    "no axis": ({"axes": np.zeros((2, 3))}, "joint 0 has an axis of length zero"),
    "names": ({"names": ("a", "a")}, "names are"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_tree_is_refused(case):
    changed, message = REFUSED[case]
    whole = {
        "parents": (-1, 0), "joints": ("revolute",) * 2, "rotations": [np.eye(3)] * 2, "positions": np.zeros((2, 3)),
        "axes": np.ones((2, 3)), "inertias": np.ones((2, 10)),
    }  # fmt: skip
    with pytest.raises(InputError, match=message):
        make_tree(**{**whole, **changed})
