"""Fits `models.kernel`: scales by maximum likelihood, weights by one linear solve.

    tau = O L + Phi c + noise,   cov = K + Phi S² Phiᵀ + diag(noise²),   weights = cov⁻¹ tau,   c = S² Phiᵀ weights

O is the Euler-Lagrange operator and K the `torque_covariance` of the samples. Phi is the friction with coefficients c,
whose prior is normal with deviations S. The joints' noise is the only regulariser. Scales and noises maximise the
marginal likelihood of the torques on a subset of the samples (L-BFGS); the weights solve N d equations (Cholesky).
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.marginal_likelihood import TorqueEquations, compiled_covariance, likeliest
from dln_jax.learning.objectives import squared_torque_errors, torque_scale
from dln_jax.learning.select import Trial
from dln_jax.mechanics.friction.curves import unit_force
from dln_jax.mechanics.friction.laws import FrictionShape, coefficients_of
from dln_jax.models.joint_friction import FrictionParameters
from dln_jax.models.kernel import KernelParameters, KernelScales, States
from dln_jax.types import InputError, Needs, require_positive
from dln_jax.zoo.catalogue import CATALOGUE

NOISIER = 3.0
"""The noise is multiplied by this if the covariance is not positive definite to rounding."""


class KernelFit(NamedTuple):
    """Model of torques, its likelihood and its errors."""

    parameters: Any
    """Parameters of the catalogue's `trigonometric-kernel`, in float64, for `samples` samples."""
    noise: Float[np.ndarray, " d"]
    """Standard deviation of the torque noise in the equations, N m or N, including torque that no such energy explains.
    It exceeds the most likely value if rounding would otherwise make the covariance indefinite."""
    likelihood: float
    """Logarithm of the marginal likelihood per torque, over all fitted samples; higher is better."""
    torque_mse: float
    """Mean over fitted samples of the sum of squared errors over joints; (N m)² or N²."""
    samples: int
    """Number of samples that the energies are built from."""
    parameter_count: int
    """Number of weights and friction coefficients."""
    seconds: float
    """Duration of the whole call, compilation included."""


def fit_kernel(
    needs: Needs,
    train: Trajectories,
    *,
    samples: int = 600,
    serial: bool = True,
    likelihood_samples: int = 60,
    iterations: int = 60,
    least_noise: float = 1e-4,
) -> KernelFit:
    """Fits the most likely energies and friction to measured torques, in float64.

    Args:
        needs: kinds of joints, gravity, and friction: viscous friction of the coordinates and joint laws except load.
        train: samples to fit; hold out those that will judge the result.
        samples: largest number of samples, evenly spaced; memory is 16 samples² d² bytes, time grows as the cube.
        serial: as for `make_trigonometric_kernel`.
        likelihood_samples: number of these samples used to fit the scales and the noise.
        least_noise: lower bound on a joint's noise, relative to its torque's deviation, for data without noise. If it
            is too low for rounding, it is multiplied by `NOISIER` until it suffices; the result holds the final value.

    Raises:
        InputError: constant torques, another number of joints than the data's, friction by load, or a setting <= 0.
    """
    from scipy.linalg import cho_solve

    counts = {"samples": samples, "likelihood_samples": likelihood_samples, "iterations": iterations}
    require_positive(**counts, least_noise=least_noise)
    if needs.degrees_of_freedom != train.degrees_of_freedom:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, the data {train.degrees_of_freedom}")
    began = time.perf_counter()
    with jax.enable_x64(True):
        unit = np.asarray(torque_scale(train))
        columns = _friction(needs, train.qd)
        # S of a coefficient: 1 / (RMS torque of one unit of it, relative to the torques' deviations).
        sizes = np.sqrt(np.mean(np.sum((columns / unit[:, None]) ** 2, axis=1), axis=0))
        deviations = 1.0 / np.where(sizes > 0, sizes, 1.0)
        every = _equations(train, columns * deviations, samples)
        some = _equations(train, columns * deviations, min(samples, likelihood_samples))
        unknowns = likeliest(needs, serial, some, unit, iterations=iterations, least_noise=least_noise)
        scales, noise = jax.tree.map(np.exp, unknowns)
        covariance = np.array(compiled_covariance(needs.joints, serial)(scales, every.states))
        covariance += every.friction @ every.friction.T
        factor, noise = _factor(covariance, noise, unit)
        weights = cho_solve(factor, every.tau.ravel())
    coefficients = deviations * (every.friction.T @ weights)
    diagonal = np.log(np.diagonal(factor[0])).sum() + 0.5 * weights.size * np.log(2 * np.pi)
    weights = weights.reshape(every.tau.shape)
    return KernelFit(
        parameters=_parameters(needs, scales, every.states, weights, coefficients),
        noise=noise,
        likelihood=float(-(0.5 * np.vdot(every.tau, weights) + diagonal) / weights.size),
        # The residual of the equations is noise² weights.
        torque_mse=float(np.mean(np.sum((noise**2 * weights) ** 2, axis=1))),
        samples=len(weights),
        parameter_count=weights.size + coefficients.size,
        seconds=time.perf_counter() - began,
    )


def choose_kernel(
    needs: Needs, train: Trajectories, validation: Trajectories, *, samples: int = 600
) -> tuple[Trial, list[Trial]]:
    """Fits a serial chain and a model without that assumption; returns the better in validation, and both trials.

    The candidate of a `Trial` is `serial`, its outcome the `KernelFit`; errors are relative to the joints' variances.
    Raises as `fit_kernel`.
    """
    trials = []
    for serial in (True, False):
        fit = fit_kernel(needs, train, samples=samples, serial=serial)
        with jax.enable_x64(True):
            model = CATALOGUE["trigonometric-kernel"].make(needs=needs, samples=fit.samples, serial=serial)
            scale = np.asarray(torque_scale(train))
        errors = squared_torque_errors(model, fit.parameters, validation, scale)
        trials.append(Trial(serial, fit, np.sum(errors, axis=1)))
    return min(trials, key=lambda trial: trial.validation), trials


def _factor(
    covariance: Float[np.ndarray, "Nd Nd"], noise: Float[np.ndarray, " d"], unit: Float[np.ndarray, " d"]
) -> tuple[Any, Float[np.ndarray, " d"]]:
    """Returns the Cholesky factor of the covariance with noise, and the noise, raised as far as rounding requires."""
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
    """Torques of one unit of every friction coefficient."""
    d = needs.degrees_of_freedom
    if "load" in needs.joint_friction:
        raise InputError("friction by load multiplies what the energies give; leave load out, or train a network")
    lever = np.eye(d) if needs.joint_map is None else np.asarray(needs.joint_map).T
    shape = FrictionShape(velocity_scale=needs.velocity_scale)
    names, rates = coefficients_of(needs.joint_friction), jnp.asarray(qd @ lever)
    units = [jax.vmap(lambda u, name=name: unit_force(name, u, shape))(rates) for name in names]
    columns = [lever * np.asarray(unit)[:, None, :] for unit in units]
    if needs.friction:
        columns.insert(0, np.eye(d) * qd[:, None, :])
    return np.concatenate([np.zeros((len(qd), d, 0)), *columns], axis=2)


def _equations(data: Trajectories, friction: Float[np.ndarray, "N d P"], most: int) -> TorqueEquations:
    rows = np.unique(np.round(np.linspace(0, len(data.tau) - 1, min(most, len(data.tau)))).astype(int))
    states = States(*(np.asarray(array[rows], float) for array in (data.q, data.qd, data.qdd)))
    return TorqueEquations(states, friction[rows].reshape(data.tau[rows].size, -1), np.asarray(data.tau[rows], float))


def _parameters(needs: Needs, scales: KernelScales, states: States, weights: np.ndarray, friction: np.ndarray) -> Any:
    d = needs.degrees_of_freedom
    own, of_laws = np.split(friction, [d if needs.friction else 0])
    kernel = jax.tree.map(jnp.asarray, KernelParameters(*states, weights, scales, own if needs.friction else None))
    if not needs.joint_friction:
        return kernel
    names = coefficients_of(needs.joint_friction)
    coefficients = dict(zip(names, map(jnp.asarray, of_laws.reshape(-1, d)), strict=True))
    return {"model": kernel, "friction": FrictionParameters(coefficients, {})}
