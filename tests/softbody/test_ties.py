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
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.softbody.ties import Tie, make_tied_step

LENGTH, MASS, G = 0.4, 1.0, 9.81
FINGER = beam(0.3, 0.05, 6, 1)
INERTIA = MASS * LENGTH**2 / 3


def pendulum(q, qd, qdd):
    """A uniform rod about its end."""
    return INERTIA * qdd + MASS * G * LENGTH / 2 * jnp.cos(q)


def tip(q):
    """Frame of the rod's end."""
    c, s = jnp.cos(q[0]), jnp.sin(q[0])
    return jnp.array([[c, -s], [s, c]]), LENGTH * jnp.array([c, s])


def carried(*, weight=True):
    """A soft finger, in the frame that carries it, and its tied vertices."""
    held = np.flatnonzero(FINGER.vertices[:, 0] < 1e-9)
    terms = [elastic(FINGER, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.3)]
    return make_scene(FINGER, [*terms, *([gravity(FINGER)] if weight else [])], held=held), held


def swing(dt, steps):
    """Young's modulus -> angles of the rod that a finger at its end is tied to, and convergence."""
    scene, held = carried()
    init, step = make_tied_step(scene, dt, [Tie(tip, held)], pendulum, BDF2)

    def motion(modulus):
        params = with_parameters(scene.params, elastic={"youngs_modulus": modulus})
        advance, inputs = lambda state, u: step(params, state, u), (jnp.zeros((steps, 1)), None)
        observe = lambda state, info: (state.robot.x[0], info.converged)  # noqa: E731
        return rollout(advance, init([0.0]), inputs, observe=observe)[1]

    return motion


def rigid_angle(seconds):
    """Angle of the rod with the finger's masses fixed to it, by small steps of the midpoint rule."""
    scene, _ = carried()
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


def test_free_robot_and_body_keep_their_momentum():
    """A cart without friction carries a finger whose end is thrown: the sum of both momenta stays, to the tolerance."""
    scene, held = carried(weight=False)
    init, step = make_tied_step(scene, 5e-3, [Tie(lambda q: (jnp.eye(2), q), held)], lambda q, qd, qdd: 2.0 * qdd)
    state = init([0.0, 0.0], v=np.where(FINGER.vertices[:, :1] > 0.2, [[0.3, 1.0]], 0.0))
    advance = jax.jit(step)

    def momentum(state):
        return 2.0 * state.robot.v + scene.params.masses @ state.body.v

    before = momentum(state)
    for _ in range(20):
        state, info = advance(scene.params, state, (jnp.zeros(2), None))
        assert info.converged
    assert np.abs(state.robot.v).max() > 0.1
    np.testing.assert_allclose(momentum(state), before, atol=1e-7)


def test_wrong_ties_are_refused():
    scene, held = carried()
    for ties, words in (
        ([], "no vertex"),
        ([Tie(tip, np.array([5]))], "tied but not held"),
        ([Tie(tip, np.array([0.2]))], "a tie is float64"),
        ([Tie(tip, held), Tie(tip, held[:1])], "tied twice"),
    ):
        with one_line(words):
            make_tied_step(scene, 1e-2, ties, pendulum)
    with one_line("ends where forces balance"):
        make_tied_step(scene, 1e-2, [Tie(tip, held)], pendulum, MIDPOINT)
