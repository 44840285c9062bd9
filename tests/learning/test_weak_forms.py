"""The weak form of the equations of motion: exact without accelerations, and steadier than them under noise."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.encoders import smooth
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.weak_forms import fit_momentum, momentum_and_rest, window_weights
from dln_jax.mechanics import trees
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError

RATE, SAMPLES, RUNS = 125.0, 500, 3
NOISE_Q, NOISE_TAU = 3e-4, 0.05
DRY = np.array([0.5, 0.2])
SCALE = 0.02


def arm():
    """Two links in a vertical plane."""
    rows = [[np.pi / 2, 0, 0, -np.pi / 2], [0, 0.5, 0, 0]]
    links = [trees.inertial_parameters(m, [0.2, 0, 0], 0.02 * np.eye(3)) for m in (2.0, 1.0)]
    return trees.serial(*trees.dh_frames(rows), links, armature=np.array([0.05, 0.02]))


@jax.jit
def torques_of_bodies(q, qd, qdd):
    return jax.vmap(functools.partial(trees.newton_euler, arm()))(q, qd, qdd)


def log(seed, *, noise_q=0.0, noise_tau=0.0):
    """Arrays of motions of the arm, with exact rates and torques."""
    random = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / RATE
    w = 2 * np.pi * np.array([0.3, 0.8, 1.3])
    a, b = random.uniform(-1, 1, (2, RUNS, 2, 3)) * [0.9, 0.5, 0.3]
    sine, cosine = np.sin(w[:, None] * t), np.cos(w[:, None] * t)
    q, qd, qdd = (
        np.moveaxis(first @ sine + second @ cosine, 1, 2).reshape(-1, 2)
        for first, second in ((a, b), (-b * w, a * w), (-a * w**2, -b * w**2))
    )
    tau = np.asarray(torques_of_bodies(q, qd, qdd))
    tau = tau + 0.2 * qd + DRY * np.tanh(qd / SCALE)
    arrays = {
        "t": np.tile(t, RUNS),
        "q": q + noise_q * random.normal(size=q.shape),
        "tau": tau + noise_tau * random.normal(size=q.shape),
        "trajectory": np.repeat(np.arange(RUNS), SAMPLES),
    }
    return arrays, {"qd": qd, "qdd": qdd}


MODEL = make_rigid_tree(arm(), friction=True, velocity_scale=SCALE)
TOLERANCES: dict[str, Any] = {"negligible": 1e-9, "rank_tolerance": 1e-8}


@jax.jit
def torques(parameters, q, qd, qdd):
    plant = dynamics(MODEL.energies(parameters))
    return jax.vmap(plant.inverse_dynamics)(q, qd, qdd)


def error(parameters):
    """nMSE on a motion that was not fitted."""
    arrays, rates = log(seed=99)
    found = np.asarray(torques(parameters, arrays["q"], rates["qd"], rates["qdd"]))
    return float(np.mean(np.mean((found - arrays["tau"]) ** 2, axis=0) / arrays["tau"].var(axis=0)))


def test_momentum_and_rest_are_the_torque():
    plant = dynamics(two_link_arm().energies)
    q, qd, qdd = jnp.array([0.3, -0.7]), jnp.array([1.2, 0.4]), jnp.array([-2.0, 3.0])

    @jax.jit
    def sum_and_torque(q, qd, qdd):
        _, change, rest = jax.jvp(functools.partial(momentum_and_rest, plant), (q, qd), (qd, qdd), has_aux=True)
        return change + rest, plant.inverse_dynamics(q, qd, qdd)

    found, torque = map(np.asarray, sum_and_torque(q, qd, qdd))
    assert found == pytest.approx(torque, rel=1e-12)


def test_windows_end_at_zero_and_integrate_by_parts():
    t = np.arange(21) / RATE
    w, slope = window_weights(20, 1 / RATE)
    p = np.sin(9 * t + 0.4)
    assert w[[0, -1]] == pytest.approx([0, 0], abs=1e-12) and w.sum() == pytest.approx(1)
    assert -slope @ p == pytest.approx(w @ (9 * np.cos(9 * t + 0.4)), rel=1e-4)


def test_a_clean_motion_is_identified_without_accelerations():
    arrays, rates = log(seed=0)
    data = schema.from_arrays({**arrays, "qd": rates["qd"], "qdd": np.full_like(rates["qdd"], 1e3)})
    fit = fit_momentum(MODEL, data, **TOLERANCES)
    assert error(fit.parameters) < 1e-7
    assert np.asarray(fit.parameters.coulomb) == pytest.approx(DRY, rel=1e-3)
    assert fit.equations > 3 * fit.parameter_count > 3 * fit.rank


@pytest.mark.slow
def test_it_does_not_mind_a_cut_off_that_ruins_accelerations():
    found = smooth(schema.from_arrays(log(0, noise_q=NOISE_Q, noise_tau=NOISE_TAU)[0]), 25.0)
    momentum = error(fit_momentum(MODEL, found.data, noise=found.noise_tau, **TOLERANCES).parameters)
    acceleration = error(fit_linear(MODEL, found.data, **TOLERANCES).parameters)
    assert momentum < 0.1 * acceleration and momentum < 1e-3


REFUSED = [
    ({"t": lambda t: t**1.5}, {}, "steps in time are not equal"),
    ({}, {"window": 9.0}, "as long as a window"),
    ({}, {"window": 0.0}, "window is 0.0"),
    ({}, {"noise": np.array([1.0, 0.0])}, "a positive number for each of 2 joints"),
]


@pytest.mark.parametrize(("changes", "settings", "message"), REFUSED)
def test_what_windows_cannot_take_is_one_line(changes, settings, message):
    arrays, rates = log(seed=0)
    arrays = {**arrays, **rates} | {key: change(arrays[key]) for key, change in changes.items()}
    with pytest.raises(InputError, match=message):
        fit_momentum(MODEL, schema.from_arrays(arrays), **settings)
