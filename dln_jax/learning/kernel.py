"""Fitting `models.trigonometric_kernel`: the scales by their likelihood, all else by one linear problem.

    tau = O L + Phi c + noise,   cov = K + Phi S² Phiᵀ + diag(noise²),   weights = cov⁻¹ tau,   c = S² Phiᵀ weights

with O the Euler-Lagrange operator, K the `own_covariance` of the samples, Phi the friction of coefficients c, whose
prior is normal with deviations S, and a noise for each joint: the regulariser, of which nothing is hidden. Scales and
noises maximise the marginal likelihood of the torques of some samples (L-BFGS; its gradient is exact), weights are the
solution of N d equations (Cholesky).
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.learning.growth import Trial
from dln_jax.learning.objectives import TORQUE, arrays, residuals, torque_scale
from dln_jax.mechanics.friction import FrictionShape, coefficients_of, unit_force
from dln_jax.models.joint_friction import FrictionParameters
from dln_jax.models.torque_covariance import States, own_covariance
from dln_jax.models.trigonometric_kernel import KernelParameters, KernelScales
from dln_jax.types import InputError, Needs, require_positive
from dln_jax.zoo.catalogue import CATALOGUE

FIRST_NOISE = 0.05
"""Of the torques' deviation, from which the search starts."""
FEW = 16
"""States whose torques' variance sets the scales to start from."""
_REFUSED = 1e10
"""Likelihood of scales whose covariance rounding leaves indefinite."""


class KernelFit(NamedTuple):
    """A model of torques, and what the data say of it."""

    parameters: Any
    """Of `trigonometric-kernel` of the catalogue, in float64, with as many samples as `parameter_count` counts."""
    noise: Float[np.ndarray, " d"]
    """Standard deviation, N m or N: of the torques, and of what no such energy explains."""
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


class _Equations(NamedTuple):
    states: States
    friction: Any
    """Phi S [N d, P]."""
    tau: Any
    """[N, d]."""


class _Unknowns(NamedTuple):
    """Logarithms."""

    scales: KernelScales
    noise: Any
    """[d]."""


def fit_kernel(
    needs: Needs,
    train: Trajectories,
    *,
    samples: int = 600,
    serial: bool = True,
    likelihood_samples: int = 80,
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
        least_noise: of a joint, relative to its torque's deviation; what keeps the equations solvable where there is
            no noise.
        friction_scale: S of a coefficient is this, over the torque of one unit of it in root mean square, each joint's
            torque in units of its deviation.

    Raises:
        InputError: torques that do not vary, joints that are not the data's, friction by load, or a setting that is not
            positive, or a least noise that is lost in rounding.
    """
    from scipy.linalg import cho_factor, cho_solve

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
        unknowns = _likeliest(needs, serial, some, unit, iterations=iterations, least_noise=least_noise)
        scales, noise = jax.tree.map(np.exp, unknowns)
        covariance = np.array(_compiled(needs.joints, serial)(scales, every.states))
        covariance += every.friction @ every.friction.T
        covariance[np.diag_indices_from(covariance)] += np.tile(noise**2, len(every.tau))
        try:
            factor = cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"the covariance of {len(covariance):,} torques is not positive definite to rounding: least_noise is "
                f"{least_noise}; take a larger one, or fewer samples"
            ) from error
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


def _equations(data: Trajectories, friction: Float[np.ndarray, "N d P"], most: int) -> _Equations:
    rows = np.unique(np.round(np.linspace(0, len(data.tau) - 1, min(most, len(data.tau)))).astype(int))
    states = States(*(np.asarray(each[rows], float) for each in (data.q, data.qd, data.qdd)))
    return _Equations(states, friction[rows].reshape(data.tau[rows].size, -1), np.asarray(data.tau[rows], float))


def _compiled(joints: tuple, serial: bool) -> Callable[..., Any]:
    return jax.jit(
        lambda scales, states: own_covariance(joints, serial, scales, states),
        compiler_options=quick_compilation(),
    )


def _likeliest(
    needs: Needs, serial: bool, equations: _Equations, unit: np.ndarray, *, iterations: int, least_noise: float
) -> _Unknowns:
    """Scales and noise that maximise the marginal likelihood."""
    from scipy.optimize import minimize

    start = _Unknowns(_start(needs, serial, equations, unit), np.log(FIRST_NOISE * unit))
    leaves, structure = jax.tree.flatten(start)
    ends = np.cumsum([leaf.size for leaf in leaves])

    def unknowns_of(x: np.ndarray) -> _Unknowns:
        parts = [each.reshape(leaf.shape) for each, leaf in zip(np.split(x, ends[:-1]), leaves, strict=True)]
        return jax.tree.unflatten(structure, parts)

    evaluate = jax.jit(_likelihood(needs.joints, serial), compiler_options=quick_compilation())

    def objective(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slopes = evaluate(unknowns_of(x), equations)
        slope = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(slopes)])
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return _REFUSED, np.zeros_like(x)
        return float(value), slope

    lowest = [(None, None)] * (ends[-1] - unit.size) + [(each, None) for each in np.log(least_noise * unit)]
    first = np.concatenate([leaf.ravel() for leaf in leaves])
    options = {"maxiter": iterations, "maxcor": 30}
    return unknowns_of(minimize(objective, first, jac=True, method="L-BFGS-B", bounds=lowest, options=options).x)


def _likelihood(joints: tuple, serial: bool) -> Callable[[_Unknowns, _Equations], Any]:
    """(unknowns, equations) -> minus its logarithm by the torque without the constant, and the slope.

    The slope is sum(W dK), W = (K⁻¹ - weights weightsᵀ) / 2: no derivative of a factorisation is taken.
    """

    def evaluate(unknowns: _Unknowns, equations: _Equations) -> Any:
        states, friction, tau = equations
        count = tau.size

        def covariance(scales: KernelScales) -> Any:
            return own_covariance(joints, serial, jax.tree.map(jnp.exp, scales), states)

        variance = jnp.exp(2 * unknowns.noise)
        noise = jnp.tile(variance, len(tau))
        lower = jnp.linalg.cholesky(covariance(unknowns.scales) + friction @ friction.T + jnp.diag(noise))
        inverse = jax.scipy.linalg.cho_solve((lower, True), jnp.eye(count, dtype=lower.dtype))
        weights = inverse @ tau.ravel()
        value = 0.5 * tau.ravel() @ weights + jnp.sum(jnp.log(jnp.diagonal(lower)))
        W = 0.5 * (inverse - jnp.outer(weights, weights))
        scales = jax.grad(lambda scales: jnp.vdot(W, covariance(scales)))(unknowns.scales)
        by_joint = 2 * variance * jnp.sum(jnp.diagonal(W).reshape(tau.shape), axis=0)
        return value / count, jax.tree.map(lambda each: each / count, _Unknowns(scales, by_joint))

    return evaluate


def _start(needs: Needs, serial: bool, equations: _Equations, unit: np.ndarray) -> KernelScales:
    """Logarithms of scales at which each energy explains torques of the size that they have, with random frames.

    A vector in a randomly turned frame keeps a third of its square where it is parallel to the joint's axis.
    """
    d = needs.degrees_of_freedom
    bodies = d if serial else 1
    q, _, qdd = (np.sqrt(np.mean(each**2, axis=0)) for each in equations.states)
    slides = np.array([joint == "prismatic" for joint in needs.joints])
    rotated = np.tile([1 / 3, 2 / 3], (d, 1))
    slid = np.stack([np.full(d, 2 / 3), 1 / (3 * np.where(q > 0, q, 1.0) ** 2)], axis=1)
    pairs = np.where(slides[:, None], slid, rotated)
    rates = unit / np.where(qdd > 0, qdd, 1.0)
    ones, none = np.ones(bodies), np.zeros(bodies)
    scales = KernelScales(rates / rates.mean(), ones, pairs, *((ones, pairs) if needs.gravity else (None, None)))
    few = States(*(each[:: max(1, len(each) // FEW)] for each in equations.states))

    def size(scales: KernelScales) -> float:
        """Mean variance of torques in units of those that were measured."""
        variance = np.diagonal(_compiled(needs.joints, serial)(scales, few)).reshape(-1, d)
        return float(np.mean(variance / unit**2))

    without = scales._replace(weight=none if needs.gravity else None)
    scales = scales._replace(inertia=ones * 0.5 / size(without))
    if needs.gravity:
        scales = scales._replace(weight=ones / size(scales._replace(inertia=none)))
    return jax.tree.map(np.log, scales)


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
