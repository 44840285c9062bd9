"""Soft bodies carried by a robot: rigid limit, momentum, static torques, contact and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.mechanics.trees import inertial_parameters, newton_euler, serial, world_frames
from dln_jax.softbody import BDF2, MIDPOINT, make_scene, rollout, with_parameters
from dln_jax.softbody.mesh import beam, box
from dln_jax.softbody.terms import elastic, gravity, stable_neo_hookean
from dln_jax.softbody.ties import Tie, make_tied_step
from dln_jax.types import InputError

LENGTH, MASS, G = 0.4, 1.0, 9.81
INERTIA = MASS * LENGTH**2 / 3


def pendulum(q, qd, qdd):
    """A uniform rod about its end."""
    return INERTIA * qdd + MASS * G * LENGTH / 2 * jnp.cos(q)


def tip(q):
    """Frame of the rod's end."""
    c, s = jnp.cos(q[0]), jnp.sin(q[0])
    return jnp.array([[c, -s], [s, c]]), LENGTH * jnp.array([c, s])


def finger(youngs_modulus=1e5):
    """A soft finger, in the frame of the rod's end, and its tied vertices."""
    mesh = beam(0.3, 0.05, 6, 1)
    held = np.flatnonzero(mesh.vertices[:, 0] < 1e-9)
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=youngs_modulus, poisson_ratio=0.3), gravity(mesh)]
    return make_scene(mesh, terms, held=held), held


def swing(integrator, dt, youngs_modulus, seconds=0.5):
    scene, held = finger(youngs_modulus)
    init, step = make_tied_step(scene, dt, [Tie(tip, held)], pendulum, integrator)

    @jax.jit
    def motion(params):
        inputs = (jnp.zeros((round(seconds / dt), 1)), None)
        return rollout(
            lambda state, u: step(params, state, u),
            init([0.0]),
            inputs,
            observe=lambda state, info: (state.robot.x[0], info.converged),
        )[1]

    return motion, scene


def rigid_angle(seconds=0.5):
    """Angle of the rod with the finger's masses fixed to it, by small steps of the midpoint rule."""
    scene, _ = finger()
    masses, at = np.asarray(scene.params.masses), scene.mesh.vertices + np.array([LENGTH, 0.0])
    inertia = INERTIA + (masses * (at**2).sum(1)).sum()
    (mx, my), q, qd, h = masses @ at, 0.0, 0.0, 1e-4

    def acceleration(q):
        return -G * (MASS * LENGTH / 2 * np.cos(q) + mx * np.cos(q) - my * np.sin(q)) / inertia

    for _ in range(round(seconds / h)):
        half = q + h / 2 * qd
        qd = qd + h * acceleration(half)
        q = half + h / 2 * qd
    return q


@pytest.mark.slow
def test_stiff_finger_moves_like_a_rigid_payload_with_second_order():
    exact, errors = rigid_angle(), []
    for dt in (1e-2, 5e-3):
        motion, scene = swing(BDF2, dt, 1e9)
        angles, converged = motion(scene.params)
        assert converged.all()
        errors.append(abs(float(angles[-1]) - exact))
    assert errors[1] < 2e-3 and 3.0 < errors[0] / errors[1] < 5.5, errors


def test_free_robot_and_body_keep_their_momentum():
    """A cart without friction carries a finger whose end is thrown: the sum of both momenta stays, to the tolerance."""
    mesh = beam(0.3, 0.05, 6, 1)
    held = np.flatnonzero(mesh.vertices[:, 0] < 1e-9)
    scene = make_scene(mesh, [elastic(mesh, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)], held=held)
    tie = Tie(lambda q: (jnp.eye(2), q), held)
    init, step = make_tied_step(scene, 5e-3, [tie], lambda q, qd, qdd: 2.0 * qdd)
    v = np.where(mesh.vertices[:, :1] > 0.2, [[0.3, 1.0]], 0.0)
    state, masses = init([0.0, 0.0], v=v), scene.params.masses
    advance = jax.jit(step)

    def momentum(state):
        return 2.0 * state.robot.v + masses @ state.body.v

    before = momentum(state)
    for _ in range(20):
        state, info = advance(scene.params, state, (jnp.zeros(2), None))
        assert info.converged
    assert np.abs(state.robot.v).max() > 0.1
    np.testing.assert_allclose(momentum(state), before, atol=1e-7)


@pytest.mark.slow
def test_arm_of_a_tree_at_rest_needs_the_static_torque_of_what_it_carries():
    """Two revolute joints in space and a bar at the flange: the torques that keep it at rest are the weight's."""
    links = [inertial_parameters(1.0, np.array([0.1, 0.0, 0.0]), 0.01 * np.eye(3))] * 2
    tree = serial([np.eye(3)] * 2, [[0.0, 0.0, 0.0], [0.2, 0.0, 0.0]], links, axes=[[0.0, -1.0, 0.0]] * 2)
    mesh = box((0.2, 0.05, 0.05), (2, 1, 1))
    held = np.flatnonzero(mesh.vertices[:, 0] < 1e-9)
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=1e6, poisson_ratio=0.3), gravity(mesh)]
    scene = make_scene(mesh, terms, held=held)

    def flange(q):
        rotations, origins = world_frames(tree, q)
        return rotations[-1], origins[-1]

    tie = Tie(flange, held)

    def robot(q, qd, qdd):
        # Brakes so strong that nothing moves: their force is what the weight exceeds the torque by.
        return newton_euler(tree, q, qd, qdd) + 1e6 * qd

    init, step = make_tied_step(scene, 0.1, [tie], robot)
    q, masses = jnp.array([0.3, -0.5]), np.asarray(scene.params.masses)
    state, advance = init(q), jax.jit(step)
    for _ in range(60):
        state, info = advance(scene.params, state, (jnp.zeros(2), None))
        assert info.converged
    _, origins = world_frames(tree, state.robot.x)
    x = np.asarray(state.body.x)
    weight = [G * masses @ (x[:, 0] - float(origin[0])) for origin in origins]
    loaded = np.asarray(newton_euler(tree, state.robot.x, jnp.zeros(2), jnp.zeros(2))) + weight
    np.testing.assert_allclose(1e6 * np.asarray(state.robot.v), -loaded, rtol=1e-4)


@pytest.mark.slow
def test_derivative_of_the_swing_equals_differences():
    motion, scene = swing(BDF2, 1e-2, 1e5, seconds=0.05)

    @jax.jit
    @jax.value_and_grad
    def angle(modulus):
        return motion(with_parameters(scene.params, elastic={"youngs_modulus": modulus}))[0][-1]

    differences = (float(angle(1e5 + 50.0)[0]) - float(angle(1e5 - 50.0)[0])) / 100.0
    np.testing.assert_allclose(float(angle(1e5)[1]), differences, rtol=1e-6)


def test_wrong_ties_are_refused():
    scene, held = finger()
    with pytest.raises(InputError, match="ends where forces balance"):
        make_tied_step(scene, 1e-2, [Tie(tip, held)], pendulum, MIDPOINT)
    with pytest.raises(InputError, match="no vertex"):
        make_tied_step(scene, 1e-2, [], pendulum)
    with pytest.raises(InputError, match="tied but not held"):
        make_tied_step(scene, 1e-2, [Tie(tip, np.array([5]))], pendulum)
    with pytest.raises(InputError, match="tied twice"):
        make_tied_step(scene, 1e-2, [Tie(tip, held), Tie(tip, held[:1])], pendulum)
