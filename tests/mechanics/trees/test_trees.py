"""Recursions over trees equal derivatives of their energies and the closed forms of a textbook scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from conftest import slow_among

from dln_jax import tree_system
from dln_jax.mechanics import jacobians
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.trees.description import dh_frames, make_tree, serial, with_payload
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.recursions import lagrangian, newton_euler, regressor
from dln_jax.scenes.pendulums import chain


def rotation(random):
    q, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def body(random):
    """That exists: moments of a cloud of points."""
    points, mass = random.normal(size=(6, 3)) * 0.2, random.uniform(0.5, 3)
    spread = np.cov(points.T, bias=True)
    return inertial_parameters(mass, points.mean(0), mass * (np.trace(spread) * np.eye(3) - spread))


def random_tree(parents, joints, axes=None):
    random, d = np.random.default_rng(7), len(parents)
    return make_tree(
        parents,
        joints,
        [rotation(random) for _ in range(d)],
        random.normal(size=(d, 3)) * 0.4,
        random.normal(size=(d, 3)) if axes is None else axes,
        [body(random) for _ in range(d)],
        armature=random.uniform(0, 0.3, d),
        gravity=(1.0, -2.0, -9.0),
    )


TREES = {
    "branched": random_tree((-1, 0, 0), ("revolute", "prismatic", "revolute")),
    "from prismatic joints": random_tree((-1, 0), ("prismatic", "revolute")),
    "one weightless joint": random_tree((-1,), ("revolute",))._replace(gravity=np.zeros(3)),
}
ARM = random_tree((-1, 0), ("revolute",) * 2, axes=np.eye(3)[[2, 2]])


@pytest.mark.parametrize("name", slow_among(TREES, lambda name: name == "branched"))
def test_recursions_equal_derivatives_of_the_energies_and_are_linear_in_the_parameters(name):
    tree = TREES[name]
    fast, slow = dynamics(tree_system(tree)), dynamics(LagrangianSystem(lagrangian(tree)))

    @jax.jit
    def answers(q, qd, qdd):
        tau = slow.inverse_dynamics(q, qd, qdd)
        at_rest = fast.inverse_dynamics(q, 0 * q, 0 * q)
        mass = jax.vmap(lambda unit: fast.inverse_dynamics(q, 0 * q, unit) - at_rest)(jnp.eye(q.size))
        expected = tau, mass, slow.energy(q, qd), qdd
        tau = fast.inverse_dynamics(q, qd, qdd)
        got = tau, fast.mass_matrix(q), fast.energy(q, qd), fast.forward_dynamics(q, qd, tau)
        return got, expected, regressor(tree, q, qd, qdd)

    got, expected, phi = answers(*np.random.default_rng(9).normal(size=(3, tree.degrees_of_freedom)))
    for one, other in zip(got[:3], expected[:3], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(got[3], expected[3], rtol=1e-10, atol=1e-10)
    theta = np.concatenate([tree.inertias.ravel(), tree.armature])
    np.testing.assert_allclose(phi @ theta, expected[0], rtol=1e-12, atol=1e-12)


def test_jacobians_equal_those_of_the_generic_way():
    tree = TREES["from prismatic joints"]
    state = np.random.default_rng(9).normal(size=(3, 2))
    ours = jax.jit(lambda *state: jacobians.inverse_dynamics_jacobians(tree_system(tree), *state))(*state)
    theirs = jax.jit(jax.jacfwd(lambda *state: newton_euler(tree, *state), argnums=(0, 1, 2)))(*state)
    np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-11)


def test_learned_numbers_give_what_known_ones_give():
    """Learned numbers are JAX arrays or traced, and nothing is known to be zero."""
    state = jnp.asarray(np.random.default_rng(9).normal(size=(3, 2)))
    known = {name: jnp.asarray(getattr(ARM, name)) for name in ("rotations", "positions", "inertias", "armature")}
    forces = jax.jit(lambda learned: newton_euler(ARM._replace(**learned), *state))
    np.testing.assert_allclose(forces(known), newton_euler(ARM, *state), rtol=1e-12)
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(jax.jit(jax.jacrev(forces))(known)))


def test_a_planar_tree_is_the_textbook_chain():
    """Rods of length 1 and mass 1 that hang along -y and turn about z."""
    rod = inertial_parameters(1.0, [0, -0.5, 0], np.diag([1 / 12, 0, 1 / 12]))
    tree = serial([np.eye(3)] * 2, [[0, 0, 0], [0, -1.0, 0]], [rod] * 2, gravity=(0, -9.81, 0))
    ours, textbook = dynamics(tree_system(tree)), dynamics(chain(2).closed_form)
    q, qd, qdd = np.random.default_rng(5).normal(size=(3, 2))
    np.testing.assert_allclose(ours.inverse_dynamics(q, qd, qdd), textbook.inverse_dynamics(q, qd, qdd), rtol=1e-12)
    np.testing.assert_allclose(ours.mass_matrix(q), textbook.mass_matrix(q), rtol=1e-12)


def test_a_payload_is_a_body_more():
    tree, random = ARM, np.random.default_rng(8)
    payload, turn, place = body(random), rotation(random), random.normal(size=3)
    loaded = with_payload(tree, 1, payload, rotation=turn, position=place)
    fixed = make_tree(
        (*tree.parents, 1),
        (*tree.joints, "revolute"),
        [*tree.rotations, turn],
        [*tree.positions, place],
        [*tree.axes, [0, 0, 1]],
        [*tree.inertias, payload],
        armature=[*tree.armature, 0],
        gravity=tree.gravity,
    )
    q, qd, qdd = random.normal(size=(3, 2))
    still = [np.append(vector, 0.0) for vector in (q, qd, qdd)]
    expected = jax.jit(dynamics(tree_system(fixed)).inverse_dynamics)(*still)[:2]
    tau = jax.jit(dynamics(tree_system(loaded)).inverse_dynamics)(q, qd, qdd)
    np.testing.assert_allclose(tau, expected, rtol=1e-12)


def test_denavit_hartenberg_rows():
    rotations, positions = dh_frames([[0, 0, 0.333, 0], [-np.pi / 2, 0, 0, 0], [np.pi / 2, 0.0825, 0.316, 0.3]])
    np.testing.assert_allclose(positions[0], [0, 0, 0.333])
    np.testing.assert_array_equal(rotations[1], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(positions[2], [0.0825, -0.316, 0], atol=1e-15)


def test_what_is_no_tree_is_refused():
    whole = {"parents": (-1, 0), "joints": ("revolute",) * 2, "rotations": [np.eye(3)] * 2}
    whole |= {"positions": np.zeros((2, 3)), "axes": np.ones((2, 3)), "inertias": np.ones((2, 10))}
    for changed, message in [
        ({"parents": (0, -1)}, "parents are"),
        ({"joints": ("revolute", "ball")}, "joints are"),
        ({"inertias": np.ones((2, 9))}, r"inertias has shape \(2, 9\); expected \(2, 10\)"),
        ({"positions": np.full((2, 3), np.nan)}, "positions has nan at"),
        ({"rotations": [np.eye(3), -np.eye(3)]}, "rotations has an invalid matrix"),
        ({"axes": np.zeros((2, 3))}, "joint 0 has an axis of length zero"),
        ({"names": ("a", "a")}, "names are"),
    ]:
        with one_line(message):
            make_tree(**{**whole, **changed})
