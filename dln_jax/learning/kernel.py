"""Fitting `models.trigonometric_kernel`: the scales by their likelihood, all else by one linear problem.

    tau = O L + Phi c + noise,   cov = K + Phi S² Phiᵀ + diag(noise²),   weights = cov⁻¹ tau,   c = S² Phiᵀ weights

with O the Euler-Lagrange operator, K the `own_covariance` of the samples, Phi the friction of coefficients c, whose
prior is normal with deviations S, and a noise for each joint: the regulariser, of which nothing is hidden. Scales and
noises maximise the marginal likelihood of the torques of some samples (L-BFGS; its gradient is exact), weights are the
solution of N d equations (Cholesky).
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.growth import Trial
from dln_jax.learning.marginal_likelihood import Equations, compiled_covariance, likeliest
from dln_jax.learning.objectives import TORQUE, arrays, residuals, torque_scale
from dln_jax.mechanics.friction import FrictionShape, coefficients_of, unit_force
from dln_jax.models.joint_friction import FrictionParameters
from dln_jax.models.torque_covariance import States
from dln_jax.models.trigonometric_kernel import KernelParameters, KernelScales
from dln_jax.types import InputError, Needs, require_positive
from dln_jax.zoo.catalogue import CATALOGUE

NOISIER = 3.0
"""Factor by which the noise grows where the covariance is not positive definite to rounding."""


class KernelFit(NamedTuple):
    """A model of torques, and what the data say of it."""

    parameters: Any
    """Of `trigonometric-kernel` of the catalogue, in float64, with as many samples as `parameter_count` counts."""
    noise: Float[np.ndarray, " d"]
    """Standard deviation that the equations have, N m or N: of the torques, and of what no such energy explains; more
    than is most likely where the covariance would not be positive definite to rounding."""
    likelihood: float
    """Logarithm of the marginal likelihood by the torque, of all fitted samples; the higher the better."""
    torque_mse: float
    """Mean over fitted samples of the sum of squared errors over joints; (N m)² or N²."""
    samples: int
    """That the energies are made of."""
    parameter_count: int
    """Weights, and coefficients of friction."""
    seconds: float
    """Of the whole call, compilation included."""


def fit_kernel(
    needs: Needs,
    train: Trajectories,
    *,
    samples: int = 600,
    serial: bool = True,
    likelihood_samples: int = 60,
    iterations: int = 60,
    least_noise: float = 1e-4,
    friction_scale: float = 1.0,
) -> KernelFit:
    """The energies and friction that are most likely, given torques; in float64.

    Args:
        needs: kinds of joints, gravity, and friction: viscous of each coordinate, and laws of joints but for load.
        train: to fit; hold out what the result is judged by.
        samples: at most, evenly spaced; memory is 16 samples² d² bytes, time grows with the third power.
        serial: as for `make_trigonometric_kernel`.
        likelihood_samples: of those, by which scales and noise are found.
        iterations: of L-BFGS, at most.
        least_noise: of a joint, relative to its torque's deviation, where data have none. What is too little for the
            rounding of the equations is raised, by `NOISIER` at a time; the result's noise says what it came to.
        friction_scale: S of a coefficient is this, over the torque of one unit of it in root mean square, each joint's
            torque in units of its deviation.

    Raises:
        InputError: torques that do not vary, joints that are not the data's, friction by load, or a setting that is not
            positive.
    """
    from scipy.linalg import cho_solve

    require_positive(
        samples=samples, likelihood_samples=likelihood_samples, iterations=iterations, least_noise=least_noise,
        friction_scale=friction_scale,
    )  # fmt: skip
    if needs.degrees_of_freedom != train.degrees_of_freedom:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, the data {train.degrees_of_freedom}")
    began = time.perf_counter()
    with jax.enable_x64(True):
        unit = np.asarray(torque_scale(train))
        columns = _friction(needs, train.qd)
        sizes = np.sqrt(np.mean(np.sum((columns / unit[:, None]) ** 2, axis=1), axis=0))
        deviations = friction_scale / np.where(sizes > 0, sizes, 1.0)
        every = _equations(train, columns * deviations, samples)
        some = _equations(train, columns * deviations, min(samples, likelihood_samples))
        unknowns = likeliest(needs, serial, some, unit, iterations=iterations, least_noise=least_noise)
        scales, noise = jax.tree.map(np.exp, unknowns)
        covariance = np.array(compiled_covariance(needs.joints, serial)(scales, every.states))
        covariance += every.friction @ every.friction.T
        factor, noise = _factor(covariance, noise, unit)
        weights = cho_solve(factor, every.tau.ravel())
    found = deviations * (every.friction.T @ weights)
    diagonal = np.log(np.diagonal(factor[0])).sum() + 0.5 * weights.size * np.log(2 * np.pi)
    weights = weights.reshape(every.tau.shape)
    return KernelFit(
        parameters=_parameters(needs, scales, every.states, weights, found),
        noise=noise,
        likelihood=float(-(0.5 * np.vdot(every.tau, weights) + diagonal) / weights.size),
        # What the equations leave over is noise² weights.
        torque_mse=float(np.mean(np.sum((noise**2 * weights) ** 2, axis=1))),
        samples=len(weights),
        parameter_count=weights.size + found.size,
        seconds=time.perf_counter() - began,
    )


def choose_kernel(
    needs: Needs, train: Trajectories, validation: Trajectories, *, samples: int = 600
) -> tuple[Trial, list[Trial]]:
    """A chain of bodies, or none assumed: the lower error at the validation samples, and both.

    Of a `Trial` the candidate is `serial`, the outcome the `KernelFit`, and the errors are squares of torques, each
    joint's in units of its deviation.

    Raises:
        InputError: as `fit_kernel`.
    """
    trials = []
    for serial in (True, False):
        fit = fit_kernel(needs, train, samples=samples, serial=serial)
        with jax.enable_x64(True):
            model = CATALOGUE["trigonometric-kernel"].factory(needs, samples=fit.samples, serial=serial)
            judge = jax.jit(lambda parameters, batch: residuals(TORQUE, model.energies(parameters), batch))  # noqa: B023
            errors = judge(fit.parameters, arrays(TORQUE, validation, jnp.float64)) / torque_scale(train)
        trials.append(Trial(serial, fit, np.sum(np.asarray(errors) ** 2, axis=1)))
    return min(trials, key=lambda trial: trial.validation), trials


def _factor(
    covariance: Float[np.ndarray, "Nd Nd"], noise: Float[np.ndarray, " d"], unit: Float[np.ndarray, " d"]
) -> tuple[Any, Float[np.ndarray, " d"]]:
    """Cholesky's, of the covariance with noise, and the noise: more than was given where rounding asks for it."""
    from scipy.linalg import cho_factor

    while (noise < unit).any():
        noisy = covariance.copy()
        noisy[np.diag_indices_from(noisy)] += np.tile(noise**2, len(noisy) // len(noise))
        try:
            return cho_factor(noisy, lower=True, overwrite_a=True, check_finite=False), noise
        except np.linalg.LinAlgError:
            noise = NOISIER * noise
    raise InputError(
        f"the covariance of {len(covariance):,} torques is not positive definite to rounding, with any noise that is "
        "less than the torques; look for samples or numbers that are extreme"
    )


def _friction(needs: Needs, qd: Float[np.ndarray, "N d"]) -> Float[np.ndarray, "N d P"]:
    """Torques of one unit of each coefficient of friction."""
    d = needs.degrees_of_freedom
    if "load" in needs.joint_friction:
        raise InputError("friction by load multiplies what the energies give; leave load out, or train a network")
    lever = np.eye(d) if needs.joint_map is None else np.asarray(needs.joint_map).T
    shape = FrictionShape(velocity_scale=needs.velocity_scale)
    names, rates = coefficients_of(needs.joint_friction), jnp.asarray(qd @ lever)
    units = [jax.vmap(lambda u, name=name: unit_force(name, u, shape))(rates) for name in names]
    columns = [lever * np.asarray(each)[:, None, :] for each in units]
    if needs.friction:
        columns.insert(0, np.eye(d) * qd[:, None, :])
    return np.concatenate([np.zeros((len(qd), d, 0)), *columns], axis=2)


def _equations(data: Trajectories, friction: Float[np.ndarray, "N d P"], most: int) -> Equations:
    rows = np.unique(np.round(np.linspace(0, len(data.tau) - 1, min(most, len(data.tau)))).astype(int))
    states = States(*(np.asarray(each[rows], float) for each in (data.q, data.qd, data.qdd)))
    return Equations(states, friction[rows].reshape(data.tau[rows].size, -1), np.asarray(data.tau[rows], float))


def _parameters(needs: Needs, scales: KernelScales, states: States, weights: np.ndarray, friction: np.ndarray) -> Any:
    """Of the catalogue's model."""
    d = needs.degrees_of_freedom
    own, of_laws = np.split(friction, [d if needs.friction else 0])
    found = jax.tree.map(jnp.asarray, KernelParameters(*states, weights, scales, own if needs.friction else None))
    if not needs.joint_friction:
        return found
    names = coefficients_of(needs.joint_friction)
    coefficients = dict(zip(names, map(jnp.asarray, of_laws.reshape(-1, d)), strict=True))
    return {"model": found, "friction": FrictionParameters(coefficients, {})}
