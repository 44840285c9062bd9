"""The weak form of the equations of motion is exact without accelerations."""

import functools

import jax
import numpy as np
import pytest
from calls import one_line
from planar_arm import ARM, motions

from dln_jax.identification.equations import flat
from dln_jax.learning.momentum import fit_momentum, momentum_and_rest, window_weights
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.trees import make_rigid_tree
from dln_jax.scenes.pendulums import two_link_arm

DRY, SCALE = np.array([0.5, 0.2]), 0.02
MODEL = make_rigid_tree(ARM, friction=True, velocity_scale=SCALE)


def log(seed):
    """Three motions of the arm of 6 s at 125 Hz, with exact rates and torques."""
    data = motions(seed, trajectories=3, samples=751, friction=False)
    return data._replace(tau=data.tau + 0.2 * data.qd + DRY * np.tanh(data.qd / SCALE))


def test_momentum_and_rest_are_the_torque():
    plant = dynamics(two_link_arm().energies)
    q, qd, qdd = np.array([[0.3, -0.7], [1.2, 0.4], [-2.0, 3.0]])
    _, change, rest = jax.jvp(functools.partial(momentum_and_rest, plant), (q, qd), (qd, qdd), has_aux=True)
    assert np.asarray(change + rest) == pytest.approx(np.asarray(plant.inverse_dynamics(q, qd, qdd)), rel=1e-12)


def test_windows_end_at_zero_and_integrate_by_parts():
    t = np.arange(21) / 125
    w, slope = window_weights(20, 1 / 125)
    p = np.sin(9 * t + 0.4)
    assert w[[0, -1]] == pytest.approx([0, 0], abs=1e-12) and w.sum() == pytest.approx(1)
    assert -slope @ p == pytest.approx(w @ (9 * np.cos(9 * t + 0.4)), rel=1e-4)


def test_a_clean_motion_is_identified_without_accelerations():
    data, test = log(0), log(99)
    data = data._replace(qdd=np.full_like(data.qdd, 1e3))
    parameters, residual, solution = fit_momentum(MODEL, data, negligible=1e-9, rank_tolerance=1e-8)
    torques = jax.jit(jax.vmap(dynamics(MODEL.energies(parameters)).inverse_dynamics))
    errors = np.asarray(torques(test.q, test.qd, test.qdd)) - test.tau
    assert np.mean(np.mean(errors**2, axis=0) / test.tau.var(axis=0)) < 1e-7
    assert np.asarray(parameters.coulomb) == pytest.approx(DRY, rel=1e-3)
    assert residual.size > 3 * len(flat(parameters)) > 3 * solution.rank


def test_what_windows_cannot_take_is_one_line():
    data = log(0)
    for given, settings, message in [
        (data._replace(t=data.t**1.5), {}, "windows need equal time steps"),
        (data, {"window": 9.0}, "as long as a window"),
        (data, {"window": 0.0}, "window is 0.0"),
        (data, {"noise": np.array([1.0, 0.0])}, "expected 2 positive numbers"),
    ]:
        with one_line(message):
            fit_momentum(MODEL, given, **settings)
