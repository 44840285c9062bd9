"""A double pendulum with friction in its joints, from noisy angles and times, driven and not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from jax.flatten_util import ravel_pytree

from dln_jax.data import schema
from dln_jax.data.encoders.smoothing import smooth_locally
from dln_jax.learning.shooting import Gauge, Noise, cut_measured_windows, measured_problem, motion
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.types import Needs

NEEDS = Needs(joints=("revolute", "revolute"), friction=True)
CHAIN = make_planar_chain(NEEDS, coordinates="absolute")
# Rods of 1 m with 1 kg at their ends, and friction in the joints.
TRUE = CHAIN.init(jax.random.key(0))._replace(
    moments=jnp.array([2.0, 1.0, 1.0]),
    weight=jnp.array([2 * 9.81, 9.81]),
    viscous=jnp.array([0.05, 0.02]),
    coulomb=jnp.array([0.1, 0.05]),
)
SURE = 4.0
"""Number of standard errors that all of a few numbers stay within, except once in a thousand times."""
NOISE, DT, LENGTH, WINDOW = 1e-3, 0.02, 61, 21
# The gauge of the true parameters, so that the fit should find exactly these.
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


def statistics(task, parameters):
    """Returns statistics of a problem without measured velocities, in units of the noise's standard deviation.

    Returns J [N, P] of measurements, starts eliminated; the step to the least of the squares, to first order; and
    standard errors of a converged fit, the roots of the diagonal of (JᵀJ)⁻¹, under the gauge if there is one.
    """
    flat, unravel = ravel_pytree(parameters)

    def both(flat, *window):
        left = task.residual(unravel(flat), *window)
        return left, left

    rows = jax.jit(jax.vmap(jax.jacfwd(both, has_aux=True), in_axes=(None, *[0] * len(task.arrays))))
    slope, left = map(np.asarray, rows(flat, *task.arrays))
    _, q, _, _, weight = task.arrays
    size = np.ones_like(left)
    size[:, : q[0].size] = np.sqrt(np.sum(weight, axis=1))[:, None]
    every, r = (size[..., None] * slope).reshape(-1, len(flat)), (size * left).ravel()
    inverse = np.linalg.inv(every.T @ every)
    measured = every.reshape(*slope.shape)[:, : q[0].size].reshape(-1, len(flat))
    return measured, -inverse @ every.T @ r, np.sqrt(np.diagonal(inverse))


@pytest.mark.parametrize("driven", [False, True])
def test_the_optimum_is_the_truth_as_well_as_noise_allows(driven):
    """From motions without torques only up to a common factor, which the gauge sets."""
    data, noise = recorded(4, driven=driven)
    # A deviation from N residuals is off by 1 / √(2 N) of it; polynomials take up less than a third of N.
    np.testing.assert_allclose(noise, NOISE, rtol=SURE / np.sqrt(2 * 0.7 * len(data.t)))
    windows = cut_measured_windows(data, WINDOW)
    known = {"noise": Noise(NOISE, tau=0.01)} if driven else {"noise": Noise(NOISE), "gauge": GAUGE}
    slope, step, errors = statistics(measured_problem(CHAIN, TRUE, windows, windows, **known), TRUE)
    true = np.asarray(ravel_pytree(TRUE)[0])
    assert np.all(np.abs(step) < SURE * errors)
    assert np.all(errors[:5] < (0.03 if driven else 0.01) * true[:5])
    if not driven:
        assert np.linalg.norm(slope @ true) < 1e-6 * np.linalg.norm(slope * true)


def test_mistakes_are_named():
    windows = cut_measured_windows(recorded(1)[0], WINDOW)
    for changed, message in [
        ({"gauge": None}, "give a gauge"),
        ({"gauge": Gauge((0.0,))}, "gauge has 1 coordinates"),
        ({"gauge": Gauge((0.0, 0.0), -1.0)}, "gauge_mass is -1"),
        ({"noise": Noise(0.0)}, "noise_q is 0"),
        ({"substeps": 0}, "substeps is 0"),
    ]:
        known = {"noise": Noise(NOISE), "gauge": GAUGE} | changed
        with one_line(message):
            task = measured_problem(CHAIN, TRUE, windows, windows, **known)
            task.residual(TRUE, *(array[0] for array in task.arrays))
