"""Fits `models.kernel`: scales by maximum likelihood, weights by one linear solve.

    tau = O L + Phi c + noise,   cov = K + Phi S² Phiᵀ + diag(noise²),   weights = cov⁻¹ tau,   c = S² Phiᵀ weights

O is the Euler-Lagrange operator and K the `torque_covariance` of the samples. Phi c is the friction; the coefficients c
have a normal prior with deviations S. The joints' noise is the only regulariser. Scales and noise maximise the marginal
likelihood of the torques on a subset of the samples; the weights solve N d equations (Cholesky).

    -log p = ½ tauᵀ cov⁻¹ tau + ½ log det cov + const,   d(-log p) = sum(W dK),   W = (cov⁻¹ - weights weightsᵀ) / 2

L-BFGS minimises -log p. Its gradient needs no derivative of a factorisation (Rasmussen and Williams 2006, "Gaussian
processes for machine learning", eq. 5.9).
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.objectives import squared_torque_errors, torque_scale
from dln_jax.learning.select import Selection, lowest, select
from dln_jax.mechanics.friction import FrictionShape, coefficients_of, unit_force
from dln_jax.models.joint_friction import FrictionParameters
from dln_jax.models.kernel import KernelParameters, KernelScales, States, torque_covariance
from dln_jax.precision import compiled
from dln_jax.types import InputError, JointKind, JointSamples, JointVector, Needs, SampleVector, require_positive
from dln_jax.zoo.descriptions import make

NOISIER = 3.0
"""Factor on the noise if the covariance is not numerically positive definite."""
FIRST_NOISE = 0.05
"""Initial noise, relative to the torques' deviation."""
FEW = 16
"""Number of states for the torque variance that sets the initial scales."""
_REFUSED = 1e10
"""Objective for scales with an indefinite covariance due to rounding."""


TorqueEquations = tuple[States, Any, Any]
"""States of the samples, regressor Phi S [N d, P] of the friction, and torques [N, d]."""
Unknowns = tuple[KernelScales, Any]
"""Logarithms of the scales and of the noise [d]."""


class KernelFit(NamedTuple):
    """A torque model with its likelihood and errors."""

    parameters: Any
    """Parameters of the catalogue's `trigonometric-kernel`, in float64, for `samples` samples."""
    noise: JointVector
    """Standard deviation of the torque noise in the equations, N m or N, including unexplained torque. It exceeds the
    most likely value if rounding would otherwise make the covariance indefinite."""
    likelihood: float
    """Log marginal likelihood per torque over all fitted samples; higher is better."""
    torque_mse: float
    """Mean over fitted samples of the sum of squared errors over joints; (N m)² or N²."""
    samples: int
    """Number of samples in the energies."""
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
        train: samples to fit; hold out trajectories for the evaluation.
        samples: largest number of samples, evenly spaced; memory is 16 samples² d² bytes, and time grows as the cube.
        serial: as for `make_trigonometric_kernel`.
        likelihood_samples: number of these samples for fitting the scales and the noise.
        least_noise: lower bound on a joint's noise, relative to its torque's deviation, for data without noise. It is
            raised by factors of `NOISIER` if rounding requires it; the result has the final value.

    Raises:
        InputError: constant torques, a different number of joints in the data, friction by load, or a setting <= 0.
    """
    from scipy.linalg import cho_solve

    counts = {"samples": samples, "likelihood_samples": likelihood_samples, "iterations": iterations}
    require_positive(**counts, least_noise=least_noise)
    if needs.degrees_of_freedom != train.degrees_of_freedom:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, the data {train.degrees_of_freedom}")
    began = time.perf_counter()
    with jax.enable_x64(True):
        unit = torque_scale(train)
        columns = _friction(needs, train.qd)
        # S of a coefficient: 1 / (RMS torque of one unit of it, relative to the torques' deviations).
        sizes = np.sqrt(np.mean(np.sum((columns / unit[:, None]) ** 2, axis=1), axis=0))
        deviations = 1.0 / np.where(sizes > 0, sizes, 1.0)
        some = _equations(train, columns * deviations, min(samples, likelihood_samples))
        unknowns = _likeliest(needs, serial, some, unit, iterations=iterations, least_noise=least_noise)
        scales, noise = jax.tree.map(np.exp, unknowns)
        states, friction, tau = _equations(train, columns * deviations, samples)
        covariance = np.array(compiled_covariance(needs.joints, serial)(scales, states)) + friction @ friction.T
        factor, noise = _factor(covariance, noise, unit)
        weights = cho_solve(factor, tau.ravel())
    coefficients = deviations * (friction.T @ weights)
    diagonal = np.log(np.diagonal(factor[0])).sum() + 0.5 * weights.size * np.log(2 * np.pi)
    weights = weights.reshape(tau.shape)
    return KernelFit(
        parameters=_parameters(needs, scales, states, weights, coefficients),
        noise=noise,
        likelihood=float(-(0.5 * np.vdot(tau, weights) + diagonal) / weights.size),
        # The residual of the equations is noise² weights.
        torque_mse=float(np.mean(np.sum((noise**2 * weights) ** 2, axis=1))),
        samples=len(weights),
        parameter_count=weights.size + coefficients.size,
        seconds=time.perf_counter() - began,
    )


def choose_kernel(needs: Needs, train: Trajectories, validation: Trajectories, *, samples: int = 600) -> Selection:
    """Fits kernels with and without the assumption of a serial chain; returns the better by validation, and both
    trials.

    The candidate of a `Trial` is `serial`, and its outcome a `KernelFit`. Errors are relative to the joints' variances.
    Raises as `fit_kernel`.
    """
    scale = torque_scale(train)

    def fit(serial: bool) -> tuple[KernelFit, SampleVector]:
        solution = fit_kernel(needs, train, samples=samples, serial=serial)
        model = make("trigonometric-kernel", needs, samples=solution.samples, serial=serial)
        errors = squared_torque_errors(model, solution.parameters, validation, scale)
        return solution, np.sum(errors, axis=1)

    return select((True, False), fit, rule=lowest)


def _factor(covariance: Float[np.ndarray, "Nd Nd"], noise: JointVector, unit: JointVector) -> tuple[Any, JointVector]:
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
        f"the covariance of {len(covariance):,} torques is not numerically positive definite, even with noise as large "
        "as the torques; look for extreme samples or numbers"
    )


def _friction(needs: Needs, qd: JointSamples) -> Float[np.ndarray, "N d P"]:
    """Returns the torques per unit of each friction coefficient."""
    d = needs.degrees_of_freedom
    if "load" in needs.joint_friction:
        raise InputError("friction by load is not linear in this model; leave load out, or train a network")
    lever = np.eye(d) if needs.joint_map is None else np.asarray(needs.joint_map).T
    shape = FrictionShape(velocity_scale=needs.velocity_scale)
    rates = jnp.asarray(qd @ lever)
    own = [np.eye(d) * qd[:, None, :]] if needs.friction else []
    units = [
        jax.vmap(functools.partial(unit_force, name, shape=shape))(rates)
        for name in coefficients_of(needs.joint_friction)
    ]
    of_laws = [lever * np.asarray(unit)[:, None, :] for unit in units]
    return np.concatenate([np.zeros((len(qd), d, 0)), *own, *of_laws], axis=2)


def _equations(data: Trajectories, friction: Float[np.ndarray, "N d P"], most: int) -> TorqueEquations:
    rows = np.unique(np.round(np.linspace(0, len(data.tau) - 1, min(most, len(data.tau)))).astype(int))
    q, qd, qdd, tau = (np.asarray(array[rows], float) for array in (data.q, data.qd, data.qdd, data.tau))
    return (q, qd, qdd), friction[rows].reshape(tau.size, -1), tau


def _parameters(needs: Needs, scales: KernelScales, states: States, weights: np.ndarray, friction: np.ndarray) -> Any:
    d = needs.degrees_of_freedom
    own, of_laws = np.split(friction, [d if needs.friction else 0])
    kernel = jax.tree.map(jnp.asarray, KernelParameters(*states, weights, scales, own if needs.friction else None))
    if not needs.joint_friction:
        return kernel
    names = coefficients_of(needs.joint_friction)
    coefficients = dict(zip(names, map(jnp.asarray, of_laws.reshape(-1, d)), strict=True))
    return {"model": kernel, "friction": FrictionParameters(coefficients, {})}


def _likeliest(
    needs: Needs, serial: bool, equations: TorqueEquations, unit: np.ndarray, *, iterations: int, least_noise: float
) -> Unknowns:
    """Returns the scales and noise that maximise the marginal likelihood."""
    from scipy.optimize import minimize

    first = start_of(needs, serial, equations, unit), np.log(FIRST_NOISE * unit)
    start, unknowns_of = ravel_pytree(first)
    evaluate = compiled(likelihood(needs.joints, serial))

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = evaluate(unknowns_of(jnp.asarray(x)), equations)
        slope = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(slopes)])
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return _REFUSED, np.zeros_like(x)
        return float(value), slope

    bounds = [(None, None)] * (start.size - unit.size) + [(lower, None) for lower in np.log(least_noise * unit)]
    options = {"maxiter": iterations, "maxcor": 30}
    solution = minimize(objective, np.asarray(start), jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return unknowns_of(jnp.asarray(solution.x))


def likelihood(joints: tuple[JointKind, ...], serial: bool) -> Callable[[Unknowns, TorqueEquations], Any]:
    """Returns (unknowns, equations) -> minus the log likelihood per torque, without the constant, and its gradient."""

    def evaluate(unknowns: Unknowns, equations: TorqueEquations) -> Any:
        states, friction, tau = equations
        logarithms, noise = unknowns

        def covariance(logarithms: KernelScales) -> Any:
            return torque_covariance(joints, serial, jax.tree.map(jnp.exp, logarithms), states)

        variance = jnp.exp(2 * noise)
        lower = jnp.linalg.cholesky(
            covariance(logarithms) + friction @ friction.T + jnp.diag(jnp.tile(variance, len(tau)))
        )
        inverse = jax.scipy.linalg.cho_solve((lower, True), jnp.eye(tau.size, dtype=lower.dtype))
        weights = inverse @ tau.ravel()
        value = 0.5 * tau.ravel() @ weights + jnp.sum(jnp.log(jnp.diagonal(lower)))
        W = 0.5 * (inverse - jnp.outer(weights, weights))
        by_scale = jax.grad(lambda logarithms: jnp.vdot(W, covariance(logarithms)))(logarithms)
        by_noise = 2 * variance * jnp.sum(jnp.diagonal(W).reshape(tau.shape), axis=0)
        return jax.tree.map(lambda total: total / tau.size, (value, (by_scale, by_noise)))

    return evaluate


def start_of(needs: Needs, serial: bool, equations: TorqueEquations, unit: np.ndarray) -> KernelScales:
    """Returns logarithms of scales for which energies with random frames predict torques of the measured size.

    On average, a randomly rotated vector keeps a third of its squared length along the joint's axis.
    """
    (states, *_), d = equations, needs.degrees_of_freedom
    ones = np.ones(d if serial else 1)
    q, _, qdd = (np.sqrt(np.mean(array**2, axis=0)) for array in states)
    slides = np.array([joint == "prismatic" for joint in needs.joints])
    slid = np.stack([np.full(d, 2 / 3), 1 / (3 * np.where(q > 0, q, 1.0) ** 2)], axis=1)
    pairs = np.where(slides[:, None], slid, [1 / 3, 2 / 3])
    rates = unit / np.where(qdd > 0, qdd, 1.0)
    scales = KernelScales(rates / rates.mean(), ones, pairs, *((ones, pairs) if needs.gravity else (None, None)))
    few = tuple(array[:: max(1, len(array) // FEW)] for array in states)

    def size(scales: KernelScales) -> float:
        """Returns the mean variance of torques relative to the measured torques; 1 if nothing moves."""
        variance = np.diagonal(compiled_covariance(needs.joints, serial)(scales, few)).reshape(-1, d)
        return float(np.mean(variance / unit**2)) or 1.0

    inertia = ones * 0.5 / size(scales._replace(weight=0 * ones) if needs.gravity else scales)
    if needs.gravity:
        scales = scales._replace(weight=ones / size(scales._replace(inertia=0 * ones)))
    return jax.tree.map(np.log, scales._replace(inertia=inertia))


@functools.lru_cache(maxsize=4)
def compiled_covariance(joints: tuple[JointKind, ...], serial: bool) -> Callable[..., Any]:
    """Returns the compiled (scales, states) -> `torque_covariance`."""
    return compiled(functools.partial(torque_covariance, joints, serial))
