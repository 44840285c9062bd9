"""A double pendulum with friction in its joints, of which noisy angles and times are known, and one that is driven."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.local_polynomials import smooth_locally
from dln_jax.data.splits import select
from dln_jax.learning import accelerations, measured_motions, motions, rates
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.measured_motions import Gauge, Noise, cut_measured_windows, motion
from dln_jax.learning.motions import Weights, cut_windows
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.measured_predictions import cut_stretches, predict_measured, prediction_metrics
from dln_jax.models.hamiltonian import make_structured_hamiltonian
from dln_jax.models.planar_chain import PlanarChainParameters, make_planar_chain
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.types import InputError, Needs

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
NOISE, DT, LENGTH, WINDOW = 1e-3, 0.02, 101, 21
GAUGE = Gauge((0.0, 0.0), 1.5)


def recorded(count, *, driven=False):
    """So many motions of 2 s, of which only angles were measured, or torques too."""
    random, t = np.random.default_rng(0), DT * jnp.arange(LENGTH)
    starts = np.concatenate([random.uniform(-2.0, 2.0, (count, 2)), random.normal(size=(count, 2))], axis=1)
    tau = (
        np.sin(random.uniform(2, 6, (count, 1, 2)) * np.asarray(t)[:, None]) if driven else np.zeros((count, LENGTH, 2))
    )
    plant = dynamics(CHAIN.energies(TRUE))
    states = np.asarray(jax.jit(jax.vmap(lambda *run: motion(plant, run[0], t, run[1], substeps=4)))(starts, tau))
    q = states[..., :2] + NOISE * random.normal(size=(count, LENGTH, 2))
    arrays = {"t": np.tile(t, count), "q": q.reshape(-1, 2), "trajectory": np.repeat(np.arange(count), LENGTH)}
    data = schema.from_arrays(arrays | ({"tau": tau.reshape(-1, 2)} if driven else {}))
    smooth = smooth_locally(data)
    return data._replace(qd=smooth.data.qd, qdd=smooth.data.qdd), smooth.noise


@pytest.fixture(scope="module")
def passive():
    return recorded(8)


def parts(data):
    return select(data, range(5)), select(data, [5]), select(data, [6, 7])


def windows_of(data):
    return cut_measured_windows(data, WINDOW)


def trained(model, data, noise, steps):
    """First to accelerations, then to motions."""
    fitted, validation, _ = parts(data)
    initial = model.init(jax.random.key(0))
    first = fit(
        accelerations.problem(model, initial, fitted, validation, gauge=GAUGE, most_samples=400), GaussNewton(steps)
    )
    task = measured_motions.problem(
        model,
        first.parameters,
        windows_of(fitted),
        windows_of(validation),
        noise=Noise(tuple(noise.tolist())),
        gauge=GAUGE,
    )
    return first, fit(task, GaussNewton(6, steps_per_dispatch=3))


def predicted_for(model, parameters, data, *, momenta=False):
    """Valid prediction time on the test motions, s."""
    stretches = cut_stretches(parts(data)[2], LENGTH, every=LENGTH)
    predicted = predict_measured(model, parameters, stretches, fitted=WINDOW, substeps=2, momenta=momenta)
    return prediction_metrics(stretches, predicted, fitted=WINDOW, variance=data.q.var(axis=0))


def test_ratios_of_a_parametric_model_are_recovered(passive):
    data, noise = passive
    np.testing.assert_allclose(noise, NOISE, rtol=0.5)
    first, second = trained(CHAIN, data, noise, 10)
    # Windows of 21 samples, less the four unknowns of each start: 2 (1 - 4 / 42) is the noise's floor.
    assert second.history[-1].loss < 1.2 * 2 * (1 - 4 / 42)
    found = second.parameters
    assert np.mean(found.moments[jnp.array([0, 2])]) == pytest.approx(GAUGE.mass, rel=1e-3)
    scale = TRUE.moments[0] / found.moments[0]
    np.testing.assert_allclose(scale * found.moments, TRUE.moments, rtol=5e-3)
    np.testing.assert_allclose(scale * found.weight, TRUE.weight, rtol=5e-3)
    np.testing.assert_allclose(scale * found.coulomb, TRUE.coulomb, atol=0.05)
    metrics = predicted_for(CHAIN, found, data)
    assert metrics["vpt_seconds"] > 0.8 * metrics["predicted_seconds"] and metrics["energy_drift"] < 1e-4
    assert metrics["vpt_seconds"] > predicted_for(CHAIN, first.parameters, data)["vpt_seconds"]


def as_velocities(data, noise):
    """The structured model with momenta that are taken to be velocities, as measurements were fitted before."""
    model = make_structured_hamiltonian(NEEDS, width=8, depth=1, dtype=jnp.float64)
    fitted, validation, _ = (part._replace(p=part.qd, pd=part.qdd) for part in parts(data))
    first = fit(rates.problem(model, fitted, validation, most_samples=400), GaussNewton(20))
    task = motions.problem(
        model,
        first.parameters,
        *(cut_windows(part, WINDOW) for part in (fitted, validation)),
        weights=Weights((*noise, np.inf, np.inf)),
        substeps=1,
    )
    return model, fit(task, GaussNewton(6, steps_per_dispatch=3)).parameters["model"]


def test_momenta_of_the_model_beat_velocities_in_their_place(passive):
    data, noise = passive
    model, parameters = as_velocities(data, noise)
    before = predicted_for(model, parameters, data, momenta=True)["vpt_seconds"]
    better = make_trigonometric(NEEDS, degree=1)
    _, training = trained(better, data, noise, 20)
    assert predicted_for(better, training.parameters, data)["vpt_seconds"] > 1.5 * before


def test_torques_tell_the_scale():
    data, _ = recorded(6, driven=True)
    far = jax.tree.map(lambda leaf: 0.8 * leaf, TRUE)
    task = measured_motions.problem(
        CHAIN, far, windows_of(select(data, range(5))), windows_of(select(data, [5])), noise=Noise(NOISE, tau=0.01)
    )
    found = fit(task, GaussNewton(30)).parameters
    np.testing.assert_allclose(found.moments, TRUE.moments, rtol=0.03)
    np.testing.assert_allclose(found.weight, TRUE.weight, rtol=0.03)


def test_mistakes_are_named(passive):
    data, _ = passive
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
        cut_stretches(data, 200, every=10)
