"""Estimates the uncertainty of a fitted model from its training data, calibrated on validation trajectories.

    uncertainty = estimate(model, parameters, train, validation, ridge=0.0).uncertainty
    torque_std = predictive(model, parameters, uncertainty.factor, uncertainty.noise)

The least-squares fit gives the covariance of the parameters (`learning.posterior`). For linear models, as fitted by
`fit_linear`, `ridge=0.0` is exact. A network trained on torques is linearised about its parameters (Laplace's
approximation), with the ridge of `RIDGES` that maximises the likelihood of the validation torques. In networks with
more than `MOST_PARAMETERS`, only the `DIRECTIONS` leading combinations are uncertain; the rest counts as known.

Residuals are not only white noise: they include model errors, and neighbouring residuals are correlated. Held-out
motions therefore scale both parts of the variance of each joint,

    a noise² + b |phi F|²,   (a, b) = (1, 1), (a, a) or (a, b), of the greatest likelihood.

The simplest form is kept unless another is better by more than half the logarithm of the effective samples per extra
factor (Schwarz 1978). Validation motions are held out and, for least squares, also each training motion in turn
(`posterior.leave_out`). Both factors are then scaled by how much the errors differ between motions (`scatter`).

A linear model is right wherever the data determine its torque, even far from the data. A state is therefore in
distribution while its deviation due to parameters is below `HARMLESS` of the torque. Above that, a state is out of
distribution if its deviation exceeds the deviations on the data, or if it leaves the range of the data. For a network,
every state outside that range is out of distribution.
"""

import math
from typing import NamedTuple

import jax
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select, select_samples
from dln_jax.learning.linear import design, design_chunks
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.posterior import TINY, Posterior, Rows, leading_directions, leave_out, posterior, spectrum
from dln_jax.models.model import Model, Parameters
from dln_jax.models.uncertainty import Domain, Uncertainty
from dln_jax.solvers.normal_equations import count
from dln_jax.types import InputError, JointVector, SampleVector, require_positive

RIDGES = (1e-18, 1e-16, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2)
RATIOS = (0.0, *map(math.pow, [10.0] * 33, np.arange(-8, 25) / 4))
"""Trial ratios b / a."""
MOST_PARAMETERS, DIRECTIONS = 1_500, 400
FOLDS = 10
"""Number of groups of training trajectories to leave out in turn."""
MOST_SAMPLES = 2_000
"""Largest number of validation samples, evenly spaced."""
HARMLESS = 0.01
"""Linear models never flag states with a deviation due to parameters below this fraction of the torque's."""
STILL = 1e-3
"""Lower bound on the range of a coordinate that rests in all data, in rad, m, 1/s or 1/s²."""
CHUNK = 256
"""Samples per call of the linearised model."""
UPPER = 0.975
"""Quantile of a two-sided 95 % band; `scatter` uses it to widen bands from few motions."""


class Estimate(NamedTuple):
    """Stored uncertainty of a model, and details of its estimate."""

    uncertainty: Uncertainty
    ridge: float
    degrees_of_freedom: JointVector
    """Number of parameters that each joint's data determine."""
    training_noise: JointVector
    """Standard deviation of the training residuals, N m or N, before calibration."""


def estimate(
    model: Model,
    parameters: Parameters,
    train: Trajectories,
    validation: Trajectories,
    *,
    ridge: float | None = None,
    unit: JointVector | None = None,
    negligible: float = 0.0,
    quantile: float = 0.999,
    margin: float = 1.25,
) -> Estimate:
    """Estimates the uncertainty of a torque model; computes in float64 for any dtype of the model.

    Args:
        model: model fitted to torques.
        parameters: its parameters.
        train: training data.
        validation: other trajectories, which may have served for model selection.
        ridge: dimensionless, as in `learning.posterior`; 0 for least squares (default: chosen by validation).
        unit: scales of the joints' residuals in the fit, N m or N (default: `torque_scale`).
        negligible: as for `fit_linear`.
        quantile: quantile of the data that sets the thresholds of `out_of_distribution`.
        margin: factor on the thresholds, since new motions of the same kind go a little further.

    Raises:
        InputError: a setting out of range, parameters that are not finite, or constant torques.
    """
    require_positive(margin=margin)
    if not 0 < quantile <= 1:
        raise InputError(f"quantile is {quantile}; expected a number above 0, and at most 1")
    if ridge is not None and not 0 <= ridge < np.inf:
        raise InputError(f"ridge is {ridge}; expected a number >= 0, or None to choose it by validation")
    with jax.enable_x64(True):
        spread = torque_scale(train)
        unit = spread if unit is None else np.asarray(unit, np.float64)
        parameters = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), parameters)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(parameters)):
            raise InputError("the parameters are not finite; train again")
        held_out, some = (thin(data, MOST_SAMPLES) for data in (validation, train))

        basis: np.ndarray | None = None

        def rows(data: Trajectories) -> Rows:
            for columns, tau, measured in design_chunks(design(model), parameters, data, CHUNK, even=False):
                columns = columns / unit[:, None]
                yield columns if basis is None else columns @ basis, (tau - measured) / unit

        if ridge != 0 and count(parameters) > MOST_PARAMETERS:
            basis = leading_directions(lambda: rows(some), DIRECTIONS)
        known = spectrum(rows(train), negligible=negligible)

        def along(data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
            """Returns Phi D⁻¹ V [N, d, P] and the residuals [N, d] of some data."""
            columns, residuals = map(np.concatenate, zip(*rows(data), strict=True))
            return columns / known.scale @ known.directions, residuals

        (fitted, _), (judged, residual) = along(some), along(held_out)
        folds, present = [], np.unique(train.trajectory)
        if ridge == 0 and len(present) > 1:  # leave out one fold of training trajectories at a time
            sd = posterior(known, 0.0).noise
            parts = (select(train, indices) for indices in np.array_split(present, min(FOLDS, len(present))))
            folds = [(*leave_out(known, sd, *along(part)), part.trajectory) for part in parts]

    def calibrated(size: float) -> tuple[float, float, Posterior, np.ndarray, np.ndarray]:
        fit = posterior(known, size)
        variances = np.sum((judged @ fit.along) ** 2, axis=2)
        parts = zip((residual, variances, held_out.trajectory), *folds, strict=True)
        noise, inflation, unlikeliness = _calibrate(fit.noise, *map(np.concatenate, parts))
        return unlikeliness, size, fit, noise, inflation

    _, chosen, fit, noise, inflation = min(map(calibrated, RIDGES if ridge is None else (ridge,)), key=lambda of: of[0])
    limits = unit * np.concatenate([np.linalg.norm(part @ fit.along, axis=2) for part in (fitted, judged)])
    factor, scale = (known.directions @ fit.along) / known.scale[:, None], known.scale
    undetermined = known.directions[:, (known.sizes == 0) & (chosen == 0)]
    if basis is not None:
        factor, scale, undetermined = basis @ factor, np.ones(len(basis)), np.zeros((len(basis), 0))
    limit = np.maximum(margin * np.quantile(limits, quantile, axis=0), TINY)
    harmless = (HARMLESS if ridge == 0 else 0.0) * spread / np.sqrt(np.maximum(inflation, TINY))
    states, others = (np.concatenate([data.q, data.qd, data.qdd], axis=1) for data in (train, validation))
    centre = (states.max(axis=0) + states.min(axis=0)) / 2
    reach = np.quantile(abs(np.concatenate([states, others]) - centre), quantile, axis=0)
    reach = np.maximum(margin * reach, STILL)
    domain = Domain(np.maximum(limit, harmless), scale, undetermined, centre, reach, harmless)
    return Estimate(
        Uncertainty(factor, unit * noise, inflation, domain), chosen, fit.degrees_of_freedom, unit * fit.noise
    )


def calibration(
    residual: SampleVector, noise: float, variance: SampleVector, samples: float
) -> tuple[float, float, float]:
    """Returns (a, b) of a noise² + b variance for the residuals of one joint, and their mean negative log-likelihood.

    Args:
        residual: validation residuals, N m or N.
        noise: standard deviation of the torque noise, from training.
        variance: variances due to the parameters.
        samples: number of independent residuals.
    """
    ratios = np.asarray(RATIOS)[:, None]
    relative = np.maximum(noise**2 + ratios * variance, TINY)
    factors = np.maximum(np.mean(residual**2 / relative, axis=1), TINY)
    both = 0.5 + 0.5 * (np.log(factors) + np.mean(np.log(relative), axis=1))
    one, best = RATIOS.index(1.0), int(np.argmin(both))
    unscaled = both[one] + 0.5 * (factors[one] - 1 - np.log(factors[one]))
    further = 0.5 * np.log(max(samples, 2.0)) / max(samples, 1.0)
    candidates = [
        (unscaled, unscaled, 1.0, 1.0),
        (both[one] + further, both[one], factors[one], factors[one]),
        (both[best] + 2 * further, both[best], factors[best], factors[best] * RATIOS[best]),
    ]
    _, unlikeliness, a, b = min(candidates)
    return float(a), float(b), float(unlikeliness)


def scatter(relative: SampleVector, trajectory: np.ndarray) -> float:
    """Returns the factor, at least 1, from the average variance of the errors to the variance for a new motion.

    With s_m the mean square of the relative residuals of motion m of M, and n_m the effective samples,

        (1 + sqrt((1 + 1 / M) (var(s) - chance))) (t / z)²    where var(s) > chance

    The first factor is the mean of s plus one standard deviation for a new motion. The second accounts for estimating a
    spread from few motions: t and z are the 97.5 % quantiles of Student's distribution with M - 1 degrees of freedom
    and of the normal distribution. Chance alone gives s a variance of 2 / n for normal residuals, and its estimate from
    M motions has the relative error e, so that chance is 2 / n (1 + 2 e) with

        e² = 2 / (M - 1) + 12 / (n M)

    Args:
        relative: residuals in units of their predicted standard deviations.
        trajectory: motion of each residual; the factor is 1 for fewer than three motions.
    """
    motions = [relative[trajectory == index] for index in np.unique(trajectory)]
    if len(motions) < 3:
        return 1.0
    M, squares = len(motions), np.array([np.mean(motion**2) for motion in motions])
    n = 1 / np.mean([1 / effective_samples(motion, np.zeros(len(motion))) for motion in motions])
    chance = 2 / n * (1 + 2 * np.sqrt(2 / (M - 1) + 12 / (n * M)))
    beyond = np.var(squares, ddof=1) - chance * np.mean(squares) ** 2
    if not beyond > 0:
        return 1.0
    from scipy.special import ndtri, stdtrit  # imported here, after commands have set BLAS's threads

    return float((1 + np.sqrt((1 + 1 / M) * beyond)) * (stdtrit(M - 1, UPPER) / ndtri(UPPER)) ** 2)


def effective_samples(residual: SampleVector, trajectory: np.ndarray) -> float:
    """Returns the effective number of samples for a variance: N / (1 + 2 sum of squared autocorrelations).

    The sum ends at the first lag with an autocorrelation below 0.05 (Bayley and Hammersley 1946, for the squares).
    """
    order = np.argsort(trajectory, kind="stable")
    residual, trajectory = residual[order], trajectory[order]
    whole, total = max(float(residual @ residual), 1e-300), 1.0
    for lag in range(1, len(residual)):
        same = trajectory[lag:] == trajectory[:-lag]
        correlation = float(residual[lag:][same] @ residual[:-lag][same]) / whole
        if not correlation >= 0.05:
            break
        total += 2 * correlation**2
    return len(residual) / total


def thin(data: Trajectories, most: int) -> Trajectories:
    """Returns at most `most` samples, evenly spaced."""
    rows = np.linspace(0, len(data.t) - 1, min(most, len(data.t))).round().astype(int)
    return select_samples(data, np.unique(rows))


def _calibrate(
    sd: np.ndarray, residual: np.ndarray, variances: np.ndarray, trajectory: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Returns the calibrated noise and inflation of each joint, and the mean negative log-likelihood."""
    joints = [
        calibration(r, float(noise), variance, effective_samples(r / np.sqrt(noise**2 + variance), trajectory))
        for r, noise, variance in zip(residual.T, sd, variances.T, strict=True)
    ]
    a, b, unlikeliness = np.array(joints).T
    expected = np.maximum(a * sd**2 + b * variances, TINY)
    factors = np.array([scatter(relative, trajectory) for relative in (residual / np.sqrt(expected)).T])
    return np.sqrt(factors * a) * sd, factors * b, float(unlikeliness.mean())
