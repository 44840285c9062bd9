"""Driven rollouts against closed forms, the balance of energy, and the metrics of predictions by their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import LagrangianSystem, dynamics
from dln_jax.data import schema
from dln_jax.mechanics.dynamics import InverseForward
from dln_jax.metrics.motions import (
    Motion,
    by_trajectory,
    follow,
    metrics_of_motions,
    motion_program,
    normalised_state_error,
    records_of,
    valid_prediction_time,
    valid_prediction_times,
)
from scripts.reports.arm.data import STARTS, published_swings, rollout_metrics

FRICTION = 0.3


def sliding_mass():
    """A free mass of 1 kg."""
    return dynamics(LagrangianSystem(lambda q, qd: 0.5 * jnp.sum(qd**2)))


def damped_oscillator():
    """1 kg on a spring of 8 N/m, with viscous friction."""
    return dynamics(
        LagrangianSystem(
            lambda q, qd: 0.5 * jnp.sum(qd**2) - 4.0 * jnp.sum(q**2),
            dissipation=lambda q, qd: 0.5 * FRICTION * jnp.sum(qd**2),
        )
    )


def recordings():
    """Two pushes of different length at uneven times, as trajectories of a free mass under tau = 6 t."""
    times = [np.array([0.0, 0.2, 0.3, 0.7, 1.0]), np.array([5.0, 5.5, 6.0])]
    t = np.concatenate(times)
    tau = 6 * np.concatenate([time - time[0] for time in times])[:, None]
    elapsed = tau / 6
    arrays = {"t": t, "q": 1 + 2 * elapsed + elapsed**3, "qd": 2 + 3 * elapsed**2, "qdd": tau, "tau": tau}
    return schema.from_arrays({**arrays, "trajectory": [0] * 5 + [1] * 3, "label": ["long", "short"]})


def predicted(system, data):
    """Motions of a system along recordings, and their energies."""
    return jax.jit(motion_program(lambda _: system))(None, records_of(data, None))


def test_a_mass_follows_recorded_torques():
    """RK4 is exact for a torque that is constant or linear in each interval."""
    data = recordings()
    motions = by_trajectory(predicted(sliding_mass(), data)[0], data)
    for index, samples in enumerate((slice(0, 5), slice(5, 8))):
        t, q, qd, tau = (array[samples].reshape(-1) for array in (data.t, data.q, data.qd, data.tau))
        dt = np.diff(t)
        held = np.cumsum(np.r_[2, tau[:-1] * dt])
        fallen = np.cumsum(np.r_[1, held[:-1] * dt + 0.5 * tau[:-1] * dt**2])
        for kind, place, rate in (("interpolated", q, qd), ("held", fallen, held)):
            motion = motions[kind][index]
            assert_allclose(motion.q[:, 0], place, rtol=1e-13)
            assert_allclose(motion.qd[:, 0], rate, rtol=1e-13)
            assert_allclose(motion.work, 0.5 * (rate**2 - 4), atol=1e-12)


def test_energy_is_the_work_of_the_torque_less_friction():
    """A damped oscillator from rest under a held torque: the work is ∫ qd (tau - friction qd) dt."""
    system = damped_oscillator()
    t, tau = jnp.linspace(0.0, 2.0, 41), jnp.full((41, 1), 1.5)
    motion = jax.jit(lambda: follow(system, jnp.zeros(1), jnp.zeros(1), tau, jnp.zeros((40, 1)), t))()
    frequency = np.sqrt(8 - FRICTION**2 / 4)
    qd = 1.5 / frequency * np.exp(-FRICTION / 2 * t) * np.sin(frequency * t)
    assert_allclose(motion.qd[:, 0], qd, atol=1e-9)
    energy = jax.vmap(system.energy)(motion.q, motion.qd)
    assert_allclose(energy - energy[0], motion.work, atol=1e-9)
    assert float(1.5 * motion.q[-1, 0] - motion.work[-1]) > 0.01  # what friction took


def test_valid_prediction_time_is_the_first_time_over_the_threshold():
    """Errors relative to 6.45 times variances 4 and 100: an offset of 0.5 in both makes 0.0101, one of 0.49 0.0097."""
    q, t = np.linspace(0, 1, 10).reshape(5, 2), np.arange(5) * 0.5 + 3.0
    for offset, seconds in (
        ([0, 0.3, 0.4, 0.49, 0.49], 2.0),
        ([0, 0.3, 0.5, 0, 0], 1.0),
        ([0, 0, 0, 0, 0.6], 2.0),
        ([9, 0, 0, 0, 0], 0.0),
        ([0, np.nan, 0, 0, 0], 0.5),
        ([0, 0, 0, -np.inf, 0], 1.5),
        ([0, 1e200, 0, 0, 0], 0.5),
    ):
        q_hat = q + np.array(offset)[:, None]
        assert valid_prediction_time(q, q_hat, t, 6.45 * np.array([4.0, 100.0])) == seconds


def test_prediction_metrics_follow_their_definitions():
    data = recordings()
    groups = slice(0, 5), slice(5, 8)
    motions = [Motion(data.q[group] + 1.0, data.qd[group] - 0.2, np.zeros(len(data.q[group]))) for group in groups]
    motions[0].q[:2] -= 1.0
    variance = np.var(data.q)
    assert_allclose(valid_prediction_times(data, motions), [0.3, 0.0])
    expected = np.sqrt((6 / 8 / variance + 0.04 / np.var(data.qd)) / 2)
    assert normalised_state_error(data, motions) == pytest.approx(expected, rel=1e-12)
    motions[1].qd[0] = np.nan
    assert normalised_state_error(data, motions) == np.inf


def test_the_true_plant_predicts_its_own_motions_and_another_does_not():
    data = recordings()
    truth = rollout_metrics(sliding_mass(), data)
    assert truth["vpt_interpolated_seconds"] == truth["rollout_seconds"] == 1.0
    assert 0 < truth["vpt_seconds"] < 1.0  # holding the torque loses a recorded motion
    assert truth["normalised_state_error"] < 1e-13 and truth["energy_error_j"] < 1e-12
    motions, energies = predicted(sliding_mass(), data)
    assert metrics_of_motions(motions._replace(work=motions.work + 1), energies, data)["energy_error_j"] > 0.5
    assert metrics_of_motions(motions, energies.at[1, 0, 1].set(jnp.nan), data)["energy_error_j"] == np.inf
    # A model without an energy is rolled out as well.
    oscillator = damped_oscillator()
    plain = InverseForward(*oscillator[:2])
    other = rollout_metrics(plain, data)
    assert 0 < other["vpt_interpolated_seconds"] < 0.6
    assert other["normalised_state_error"] > 0.1
    assert "energy_error_j" not in other


def test_recordings_that_cannot_be_followed_are_refused():
    data = recordings()
    for changes, words in (
        ({"trajectory": np.array([0] * 7 + [1])}, "trajectory 'short' has 1 sample; a rollout needs at least 2"),
        ({"q": np.ones_like(data.q)}, r"q\[:, 0\] is the same in all samples"),
        ({"trajectory": np.zeros(0, int)}, "no trajectories"),
    ):
        with one_line(words):
            rollout_metrics(sliding_mass(), data._replace(**changes))


def test_published_swings_are_the_symplectic_euler_map_of_the_arm():
    data = published_swings()
    assert data.q.shape == (1200, 2) and data.t[399] == pytest.approx(7.98)
    assert_array_equal(data.tau, 0.0)
    assert_array_equal(data.q[::400], STARTS)
    # The published formulas of the plant, whose angle zero is horizontal, by plain numpy.
    q, qd = data.q[[0, 400, 800]].T, np.zeros((2, 3))
    for step in range(100):
        cosine, sine, weight = np.cos(q[1]), np.sin(q[1]), 1.5 * np.cos(q[0] + q[1])
        a, b, c = 1.3727291666666667 + cosine, 0.5176145833333333 + 0.5 * cosine, 0.5176145833333333
        first = 0.5 * sine * (2 * qd[0] * qd[1] + qd[1] ** 2) - 2.625 * np.cos(q[0]) - weight
        second = -0.5 * sine * qd[0] ** 2 - weight
        qdd = np.array([c * first - b * second, a * second - b * first]) / (a * c - b**2)
        if step % 10 == 0:
            assert_allclose(data.q[step // 10 :: 400].T, q, atol=1e-12)
            assert_allclose(data.qdd[step // 10 :: 400].T, qdd, atol=1e-11)
        qd = qd + 0.002 * qdd
        q = q + 0.002 * qd
