"""A momentum observer finds external torques at its own rate, contacts, and the wrench at a flange."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line
from numpy.testing import assert_allclose
from planar_arm import LINKS

import dln_jax
from dln_jax.control.estimate.external import (
    block_maxima,
    contact_threshold,
    flange_wrench,
    momentum_observer,
    observed,
)
from dln_jax.control.state_space import field_of, integrated
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.mechanics.friction import FrictionCoefficients, FrictionShape
from dln_jax.mechanics.trees.description import serial
from dln_jax.mechanics.trees.frames import frame_jacobian, world_frames
from dln_jax.scenes.pendulums import two_link_pendulum
from dln_jax.scenes.scene import with_friction

RATE = 500.0


def arm(d):
    """An arm whose joints are turned against each other."""
    random = np.random.default_rng(0)
    rotations = [np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(d)]
    rotations = np.stack([R * np.sign(np.linalg.det(R)) for R in rotations])
    return serial(rotations, 0.3 * random.normal(size=(d, 3)), np.tile(LINKS[0], (d, 1)))


SCENE = with_friction(two_link_pendulum("elbow"), FrictionCoefficients(viscous=(0.05, 0.02)), FrictionShape())
MODEL = dln_jax.dynamics(SCENE.closed_form)
STEP = integrated(field_of(MODEL), 1 / RATE)


def motion(external, noise, key):
    """q, qd and commanded torques of the arm under PD control, with external torques and disturbances [N, 2]."""
    # Double integrals of noise drift away: bounded angles.
    wanted = jnp.sin(2e-5 * jnp.cumsum(jnp.cumsum(jax.random.normal(key, noise.shape), axis=0), axis=0))

    def sample(x, row):
        wanted, external, noise = row
        q, qd = jnp.split(x, 2)
        tau = MODEL.inverse_dynamics(q, 0 * qd, 0 * qd) + 6 * (wanted - q) - 0.8 * qd

        return STEP(x, tau + external + noise), (q, qd, tau)

    return jax.lax.scan(sample, jnp.zeros(4), (wanted, jnp.asarray(external), jnp.asarray(noise)))[1]


def test_the_residual_approaches_a_constant_push_at_the_observers_rate():
    push = np.array([0.3, -0.2])
    samples = 200
    gain = 25.0
    external = np.where(np.arange(samples)[:, None] >= 50, push, 0.0)
    observer = momentum_observer(MODEL, 2, rate=RATE, gain=gain)
    r = jax.jit(lambda: observed(observer, *motion(external, np.zeros((samples, 2)), jax.random.key(0))))()
    since = np.maximum(np.arange(samples) - 50, 0) / RATE
    assert_allclose(r, (1 - np.exp(-gain * since))[:, None] * push, rtol=0, atol=2e-4)


def test_false_alarms_come_at_the_stated_rate_and_a_push_is_found():
    observer = momentum_observer(MODEL, 2, rate=RATE, gain=30.0)

    @jax.jit
    def residuals(external, key):
        noise = 0.05 * jax.random.normal(key, external.shape)
        return observed(observer, *motion(external, noise, key))

    free = np.zeros((20_000, 2))
    recordings = [np.asarray(residuals(free, jax.random.key(seed))) for seed in range(3)]
    band = np.sqrt(np.mean(recordings[0] ** 2, axis=0))
    scores = [np.max(np.abs(r) / band, axis=1) for r in recordings]
    # 720 alarms an hour are one in five seconds: 16 in the 80 s of the two other recordings.
    threshold = contact_threshold(scores[0], rate=RATE, false_alarms=720.0)
    alarms = sum(int(np.sum(block_maxima(part, rate=RATE) > threshold)) for part in scores[1:])
    assert 5 <= alarms <= 32
    pushed = np.where(np.arange(1000)[:, None] >= 500, [0.0, 0.3], 0.0)
    r = residuals(pushed, jax.random.key(9))
    rare = contact_threshold(scores[0], rate=RATE, false_alarms=6.0)
    alarm = np.max(np.abs(r) / band, axis=1) > rare
    assert not alarm[:500].any() and alarm[500:600].any() and rare > threshold


def test_the_wrench_at_a_flange_is_found_where_the_joints_determine_it():
    wrench = np.array([3.0, -1.0, 2.0, 0.2, 0.1, -0.3])
    J = jnp.asarray(np.random.default_rng(1).normal(size=(6, 7)))
    result, determined, residual = flange_wrench(J, J.T @ wrench)
    assert_allclose(result, wrench, rtol=1e-9)
    assert determined and residual < 1e-9
    # Five joints do not determine six components: the wrench explains the torques, and says so.
    _, determined, residual = flange_wrench(J[:, :5], J[:, :5].T @ wrench)
    assert not determined and residual < 1e-9
    elsewhere, _, residual = flange_wrench(J, np.array([0.0, 0, 0, 0, 0, 0, 1.0]))
    assert np.isfinite(elsewhere).all() and residual > 1e-3


def test_the_jacobian_of_a_frame_is_the_derivative_of_its_place():
    tree = arm(4)
    q = jnp.asarray([0.3, -1.0, 0.5, 0.2])
    J = frame_jacobian(tree, 3, (0.1, 0.2, 0.0))(q)

    def place(q):
        rotations, origins = world_frames(tree, q)
        return origins[3] + rotations[3] @ jnp.array([0.1, 0.2, 0.0]), rotations[3]

    of_point, of_rotation = jax.jacfwd(place)(q)
    assert_allclose(J[:3], of_point, atol=1e-12)
    spin = jnp.einsum("abj,cb->acj", of_rotation, place(q)[1])
    assert_allclose(J[3:], jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]]), atol=1e-12)


def test_observers_without_what_they_need_are_refused():
    with one_line("no energy"):
        momentum_observer(InverseForward(*MODEL[:2]), 2, rate=RATE, gain=1.0)
    with one_line("gain is"):
        momentum_observer(MODEL, 2, rate=RATE, gain=[1.0, 0.0, 1.0])
    with one_line("20 s or more"):
        contact_threshold(np.ones(100), rate=RATE, false_alarms=1.0)
    with one_line("link is 9"):
        frame_jacobian(arm(2), 9)
