"""Noise on torques and accelerations, and friction that a model lacks.

Least squares with P determined parameters and noise of variance s² on each of N d equations predicts the noiseless
torques with a mean square of s² P / N per sample (sum over joints), the sampling error of which is sqrt(2/P) of it.
Noise e on qdd acts like torque noise M e and, since it is part of the regressors too, makes M too small by
s² / (s² + var(qdd)) at most (Fuller 1987, "Measurement Error Models").
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories, column
from dln_jax.learning.linear import LinearFit, fit_linear
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import mean_square
from dln_jax.models.model import Model
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import double_pendulum, two_link_arm
from scripts.reports.case import Findings
from scripts.reports.rows import expect
from scripts.reports.stability.misfit import velocity_misfit

LEVELS = (1e-4, 1e-2, 1e-1)
"""Standard deviations of the noise, relative to that of the quantity."""
SAMPLES = 600
FRICTION = 0.2
"""Viscous friction, N m s."""
DEVIATIONS = 4.0
"""A sum of squares of noise may exceed its mean by this number of standard deviations."""


def noise() -> Findings:
    """Errors of a linear fit on noisy torques and on noisy accelerations, against what theory predicts."""
    scene = two_link_arm()
    data, random = generators.uniform(scene, samples=SAMPLES), np.random.default_rng(1)
    model = make_trigonometric(scene.needs)
    rows = []
    inertia = np.linalg.norm(np.asarray(jax.vmap(scene.mass_matrix)(jnp.asarray(data.q))), axis=(1, 2))
    for level in LEVELS:
        for kind, key in (("torque", "tau"), ("acceleration", "qdd")):
            clean = getattr(data, key)
            size = level * clean.std(axis=0)
            fit, error = _fit(model, data, **{key: clean + size * random.normal(size=clean.shape)})
            bound = 1 + DEVIATIONS * (2 / fit.rank) ** 0.5
            if kind == "torque":
                # Channels are weighed by their own deviation, so that noise is the same in all.
                predicted = float(np.mean(size**2) * fit.rank / SAMPLES)
                bound *= float(np.max(size**2) / np.mean(size**2))
                text = f"s² P / N, P = {fit.rank}, within {DEVIATIONS:.0f} deviations of its chance"
            else:
                variance = float(np.mean(inertia**2) * np.max(size**2))
                predicted = variance * fit.rank / SAMPLES + level**4 * mean_square(column(data, "tau_inertial"))
                text = "|M|² s² P / N plus the square of the bias s²/var(qdd) of M"
            name, text = f"noise/{kind}-{level:g}", f"torque MSE in units of {text}"
            rows.append(expect(name, "error_over_prediction", text, error / predicted, bound, reference=1.0))
    return Findings(rows)


def missing_friction() -> Findings:
    """A scene with friction, fitted by models without and with friction."""
    scene = double_pendulum(friction=FRICTION)
    data, random = generators.uniform(scene, samples=SAMPLES), np.random.default_rng(2)
    sigma = 1e-2 * float(data.tau.std())
    noisy = data._replace(tau=data.tau + sigma * random.normal(size=data.tau.shape))
    rows = []
    for kind, needs in (("lacking", scene.needs._replace(friction=False)), ("having", scene.needs)):
        model = make_trigonometric(needs)
        fit = fit_linear(model, noisy)
        misfit = velocity_misfit(noisy.qd, noisy.tau - _torque(model, fit, noisy), noisy.trajectory)
        name = f"friction/model-{kind}-it"
        missing = misfit.missing.sum()
        if kind == "having":
            text = "a model with friction leaves noise, and nothing is found in it"
            rows.append(expect(name, "joints_reported", text, missing, 0.0))
            continue
        text = "both joints are reported, by the power that the residual takes"
        rows.append(expect(name, "joints_reported", text, missing, 2.0, at_least=True))
        # A sum over samples of qd (noise and what the fit left), over that of qd².
        allowed = float(np.max(DEVIATIONS * misfit.residual_rms / np.sqrt(np.sum(noisy.qd**2, axis=0))))
        errors = f"{DEVIATIONS:.0f} standard errors"
        text = f"the coefficient is {FRICTION} within {errors}: friction is odd in time, tau not"
        got = abs(misfit.coefficient - FRICTION).max()
        rows.append(expect(name, "coefficient_error", text, got, allowed, "N m s"))
        text = "the residual is that of friction, b rms(qd), far above the noise"
        got = np.min(misfit.residual_rms) / sigma
        expected = FRICTION * float(np.sqrt(np.mean(noisy.qd**2))) / sigma
        rows.append(expect(name, "residual_over_noise", text, got, 0.8 * expected, at_least=True, reference=expected))
    return Findings(rows)


def _fit(model: Model, data: Trajectories, **noisy: np.ndarray) -> tuple[LinearFit, float]:
    """The fit to noisy data, and its torque MSE on the noiseless ones."""
    fit = fit_linear(model, data._replace(**noisy))
    return fit, mean_square(_torque(model, fit, data) - data.tau)


def _torque(model: Model, fit: LinearFit, data: Trajectories) -> np.ndarray:
    torque = jax.jit(jax.vmap(dynamics(model.energies(fit.parameters)).inverse_dynamics))
    return np.asarray(torque(data.q, data.qd, data.qdd))
