"""Soft bodies carried by a robot: rigid limit, momentum, static torques, contact and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from impact_derivatives import require_gradient_of_differences

from dln_jax.rollout import rollout
from dln_jax.softbody.integrators import BDF2, MIDPOINT
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import Motion
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.softbody.ties import make_tied_step

LENGTH, MASS, G = 0.4, 1.0, 9.81
FINGER = beam(0.3, 0.05, 6, 1)
INERTIA = MASS * LENGTH**2 / 3


def pendulum(q, qd, qdd):
    """A uniform rod about its end."""
    return INERTIA * qdd + MASS * G * LENGTH / 2 * jnp.cos(q)


def at_tip(q, x):
    """Places on the rod's end."""
    c, s = jnp.cos(q[0]), jnp.sin(q[0])
    return x @ jnp.array([[c, s], [-s, c]]) + LENGTH * jnp.array([c, s])


def carried(*, weight=True):
    """A soft finger, in the frame that carries its held vertices."""
    held = np.flatnonzero(FINGER.vertices[:, 0] < 1e-9)
    terms = [elastic(FINGER, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)]
    return make_scene(FINGER, [*terms, *([gravity(FINGER)] if weight else [])], held=held)


def swing(dt, steps):
    """Young's modulus -> angles of the rod that a finger at its end is tied to, and convergence."""
    scene = carried()
    init, step = make_tied_step(scene, dt, at_tip, pendulum, BDF2)

    def motion(modulus):
        params = with_parameters(scene.params, elastic={"youngs_modulus": modulus})
        observe = lambda state, info: (state.robot.x[0], info.converged)  # noqa: E731
        return rollout(lambda state, _: step(params, state), init([0.0]), steps=steps, observe=observe)[1]

    return motion


def rigid_angle(seconds):
    """Angle of the rod with the finger's masses fixed to it, by small steps of the midpoint rule."""
    scene = carried()
    masses, at = np.asarray(scene.params.masses), FINGER.vertices + np.array([LENGTH, 0.0])
    inertia = INERTIA + masses @ (at**2).sum(1)
    mx, my = masses @ at + [MASS * LENGTH / 2, 0.0]
    q, qd, h = 0.0, 0.0, 1e-4
    for _ in range(round(seconds / h)):
        half = q + h / 2 * qd
        qd -= h * G * (mx * np.cos(half) - my * np.sin(half)) / inertia
        q = half + h / 2 * qd
    return q


def test_stiff_finger_moves_like_a_rigid_payload_with_second_order():
    exact, errors = rigid_angle(0.5), []
    for steps in (50, 100):
        angles, converged = jax.jit(swing(0.5 / steps, steps))(1e9)
        assert converged.all()
        errors.append(abs(float(angles[-1]) - exact))
    assert errors[1] < 2e-3 and 3.0 < errors[0] / errors[1] < 5.5, errors


def test_derivative_of_the_swing_equals_differences():
    motion = swing(1e-2, 5)

    def outcome(modulus):
        angles, converged = motion(modulus[0])
        return angles[-1], converged

    require_gradient_of_differences(outcome, np.array([1e5]), np.array([50.0]))


def test_the_momentum_of_robot_and_body_grows_by_the_impulse_on_the_robot():
    """A cart without friction is pushed and carries a finger whose end is thrown, to the tolerance."""
    scene = carried(weight=False)
    init, step = make_tied_step(scene, 5e-3, lambda q, x: x + q, lambda q, qd, qdd: 2.0 * qdd)
    state = init([0.0, 0.0], v=np.where(FINGER.vertices[:, :1] > 0.2, [[0.3, 1.0]], 0.0))
    advance = jax.jit(step)

    def momentum(state):
        return 2.0 * state.robot.v + scene.params.masses @ state.body.v

    before, push = momentum(state), jnp.array([0.5, 0.0])
    for _ in range(20):
        state, info = advance(scene.params, state, None, Motion(torque=push))
        assert info.converged
    assert np.abs(state.robot.v).max() > 0.1
    np.testing.assert_allclose(momentum(state), before + 20 * 5e-3 * push, atol=1e-7)


def test_what_a_robot_cannot_carry_is_refused():
    scene = carried()
    for settings, words in (
        ((scene._replace(held=np.arange(0)), 1e-2, at_tip, pendulum), "has no held vertex"),
        ((scene, 1e-2, at_tip, pendulum, MIDPOINT), "ends in a balance of forces"),
    ):
        with one_line(words):
            make_tied_step(*settings)
    with one_line(r"carry returned positions of shape \(2, 2\)"):
        make_tied_step(scene, 1e-2, lambda q, x: at_tip(q, x[:2]), pendulum).init([0.0])
    init, step = make_tied_step(scene, 1e-2, at_tip, pendulum)
    with one_line("but the robot moves them"):
        step(scene.params, init([0.0]), None, Motion(held=FINGER.vertices[scene.held]))
