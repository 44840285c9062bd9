"""A double pendulum with friction in its joints, from noisy angles and times, and one that is driven."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from dln_jax.data import schema
from dln_jax.data.encoders import smooth_locally
from dln_jax.data.splits import select
from dln_jax.learning import accelerations, measured_motions
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.measured_motions import Gauge, Noise, cut_measured_windows, motion
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.measured_predictions import cut_segments, predict_measured, prediction_metrics
from dln_jax.models.planar_chain import PlanarChainParameters, make_planar_chain
from dln_jax.types import InputError, Needs
from tests.standard_errors import SURE, statistics

pytestmark = pytest.mark.slow

NEEDS = Needs(joints=("revolute", "revolute"), friction=True)
CHAIN = make_planar_chain(NEEDS, coordinates="absolute")
# Rods of 1 m with 1 kg at their ends, and friction in the joints.
TRUE = PlanarChainParameters(
    moments=jnp.array([2.0, 1.0, 1.0]),
    skew=None,
    armature=None,
    weight=jnp.array([2 * 9.81, 9.81]),
    sideways=None,
    viscous=jnp.array([0.05, 0.02]),
    coulomb=jnp.array([0.1, 0.05]),
)
NOISE, DT, LENGTH, WINDOW = 1e-3, 0.02, 61, 21
# That of the true parameters, so that these are what is to be found.
GAUGE = Gauge((0.0, 0.0), 1.5)


def recorded(count, *, driven=False):
    """Motions of 1.2 s with measured angles, and with or without torques."""
    random, t = np.random.default_rng(0), DT * jnp.arange(LENGTH)
    starts = np.concatenate([random.uniform(-2.0, 2.0, (count, 2)), random.normal(size=(count, 2))], axis=1)
    size = float(driven) * np.sin(random.uniform(2, 6, (count, 1, 2)) * np.asarray(t)[:, None])
    plant = dynamics(CHAIN.energies(TRUE))
    states = np.asarray(jax.jit(jax.vmap(lambda *run: motion(plant, run[0], t, run[1], substeps=4)))(starts, size))
    q = states[..., :2] + NOISE * random.normal(size=(count, LENGTH, 2))
    arrays = {"t": np.tile(t, count), "q": q.reshape(-1, 2), "trajectory": np.repeat(np.arange(count), LENGTH)}
    data = schema.from_arrays(arrays | ({"tau": size.reshape(-1, 2)} if driven else {}))
    smooth = smooth_locally(data)
    return data._replace(qd=smooth.data.qd, qdd=smooth.data.qdd), smooth.noise


def parts(data):
    return select(data, range(6)), select(data, [6]), select(data, [7])


def windows_of(data):
    return cut_measured_windows(data, WINDOW)


class Fitted(NamedTuple):
    data: Any
    task: Any
    first: Any
    """Result of the fit to accelerations."""
    second: Any
    """Result of the fit to motions."""


@pytest.fixture(scope="module")
def passive():
    """Motions without torques, and a chain fitted to them, first to accelerations, then to motions."""
    data, noise = recorded(8)
    # A deviation from N residuals is off by 1 / √(2 N) of it; polynomials take up less than a third of N.
    np.testing.assert_allclose(noise, NOISE, rtol=SURE / np.sqrt(2 * 0.7 * len(data.t)))
    fitted, validation, _ = parts(data)
    start = CHAIN.init(jax.random.key(0))
    first = fit(accelerations.problem(CHAIN, start, fitted, validation, gauge=GAUGE), GaussNewton(15))
    task = measured_motions.problem(
        CHAIN, first.parameters, windows_of(fitted), windows_of(validation), noise=Noise(NOISE), gauge=GAUGE
    )
    second = fit(task, GaussNewton(15, steps_per_dispatch=15, improvement=1e-12))
    return Fitted(data, task, first.parameters, second)


def predicted_for(model, parameters, data, *, momenta=False):
    """Valid prediction time on the test motion, and more."""
    segments = cut_segments(parts(data)[2], LENGTH, every=LENGTH)
    predicted = predict_measured(model, parameters, segments, fitted=WINDOW, substeps=2, momenta=momenta)
    return prediction_metrics(segments, predicted, fitted=WINDOW, variance=data.q.var(axis=0))


@pytest.mark.slow
def test_parameters_are_recovered_as_well_as_noise_allows(passive):
    found = passive.second.parameters
    at = statistics(passive.task, found)
    # A multiple of all parameters has the same motions, which the gauge alone tells apart, and is met by.
    true, values = (np.asarray(ravel_pytree(each)[0]) for each in (TRUE, found))
    assert np.linalg.norm(at.slope @ values) < 1e-6 * np.linalg.norm(at.slope * values)
    assert np.mean(found.moments[jnp.array([0, 2])]) == pytest.approx(GAUGE.mass, rel=1e-6)
    # The fit has converged, so that what parts it from the truth is noise.
    assert np.all(np.abs(at.step) < 0.02 * at.errors)
    assert np.all(np.abs(values - true) < SURE * at.errors)
    assert np.all(at.errors[:5] < 0.01 * true[:5])
    assert abs(at.squares / at.freedom - 1) < SURE * np.sqrt(2 / at.freedom)


def test_motions_are_predicted_as_by_the_true_model(passive):
    exact, found, first = (
        predicted_for(CHAIN, each, passive.data) for each in (TRUE, passive.second.parameters, passive.first)
    )
    assert found["vpt_seconds"] > 0.9 * exact["vpt_seconds"] and found["energy_drift"] < 1e-4
    assert found["vpt_seconds"] >= first["vpt_seconds"]


def test_torques_tell_the_scale():
    data, _ = recorded(4, driven=True)
    windows = windows_of(data)
    task = measured_motions.problem(CHAIN, TRUE, windows, windows, noise=Noise(NOISE, tau=0.01))
    at = statistics(task, TRUE)
    true = np.asarray(ravel_pytree(TRUE)[0])
    assert np.all(np.abs(at.step) < SURE * at.errors)
    assert np.all(at.errors[:5] < 0.03 * true[:5])


def test_mistakes_are_named(passive):
    data = passive.data
    windows, start = windows_of(data), TRUE
    refused = [
        ({"gauge": None}, "give a gauge"),
        ({"gauge": Gauge((0.0,))}, "gauge has 1 coordinates"),
        ({"gauge": Gauge((0.0, 0.0), -1.0)}, "gauge_mass is -1"),
        ({"noise": Noise(0.0)}, "noise_q is 0"),
        ({"substeps": 0}, "substeps is 0"),
    ]
    for changed, message in refused:
        known = {"noise": Noise(NOISE), "gauge": GAUGE} | changed
        with pytest.raises(InputError, match=message):
            task = measured_motions.problem(CHAIN, start, windows, windows, **known)
            task.residual(start, *(array[0] for array in task.arrays))
    with pytest.raises(InputError, match="has 200 samples to predict"):
        cut_segments(data, 200, every=10)
