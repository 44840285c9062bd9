"""Fits the scales and noise of the energies of `models.kernel` by the marginal likelihood of torques.

    -log p = ½ tauᵀ cov⁻¹ tau + ½ log det cov + const,   cov = K + Phi S² Phiᵀ + diag(noise²)

The notation is that of `learning.kernel`. L-BFGS minimises -log p. Its gradient is

    sum(W dK),   W = (cov⁻¹ - weights weightsᵀ) / 2

and differentiates no factorisation (Rasmussen and Williams 2006, "Gaussian processes for machine learning", eq. 5.9).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from dln_jax.compilation import quick_compilation
from dln_jax.models.kernel import KernelScales, States, torque_covariance
from dln_jax.types import JointKind, Needs

FIRST_NOISE = 0.05
"""Initial noise, relative to the torques' deviation."""
FEW = 16
"""Number of states whose torque variance sets the initial scales."""
_REFUSED = 1e10
"""Objective of scales whose covariance is indefinite due to rounding."""


class TorqueEquations(NamedTuple):
    """Torques of samples, and the regressor of their friction."""

    states: States
    friction: Any
    """Phi S [N d, P]."""
    tau: Any
    """[N, d]."""


class Unknowns(NamedTuple):
    """Logarithms of the scales and of the noise."""

    scales: KernelScales
    noise: Any
    """[d]."""


def likeliest(
    needs: Needs, serial: bool, equations: TorqueEquations, unit: np.ndarray, *, iterations: int, least_noise: float
) -> Unknowns:
    """Returns the scales and noise that maximise the marginal likelihood."""
    from scipy.optimize import minimize

    unknowns = Unknowns(start_of(needs, serial, equations, unit), np.log(FIRST_NOISE * unit))
    start, unknowns_of = ravel_pytree(unknowns)
    evaluate = jax.jit(likelihood(needs.joints, serial), compiler_options=quick_compilation())

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
    """(unknowns, equations) -> minus the log likelihood per torque, without the constant, and its gradient."""

    def evaluate(unknowns: Unknowns, equations: TorqueEquations) -> Any:
        states, friction, tau = equations
        count = tau.size

        def covariance(scales: KernelScales) -> Any:
            return torque_covariance(joints, serial, jax.tree.map(jnp.exp, scales), states)

        variance = jnp.exp(2 * unknowns.noise)
        noise = jnp.tile(variance, len(tau))
        lower = jnp.linalg.cholesky(covariance(unknowns.scales) + friction @ friction.T + jnp.diag(noise))
        inverse = jax.scipy.linalg.cho_solve((lower, True), jnp.eye(count, dtype=lower.dtype))
        weights = inverse @ tau.ravel()
        value = 0.5 * tau.ravel() @ weights + jnp.sum(jnp.log(jnp.diagonal(lower)))
        W = 0.5 * (inverse - jnp.outer(weights, weights))
        scales = jax.grad(lambda scales: jnp.vdot(W, covariance(scales)))(unknowns.scales)
        by_joint = 2 * variance * jnp.sum(jnp.diagonal(W).reshape(tau.shape), axis=0)
        return value / count, jax.tree.map(lambda slope: slope / count, Unknowns(scales, by_joint))

    return evaluate


def start_of(needs: Needs, serial: bool, equations: TorqueEquations, unit: np.ndarray) -> KernelScales:
    """Returns logarithms of scales that make the energies explain torques of the measured size, with random frames.

    A randomly rotated vector keeps on average a third of its squared length along the joint's axis.
    """
    d = needs.degrees_of_freedom
    bodies = d if serial else 1
    q, _, qdd = (np.sqrt(np.mean(array**2, axis=0)) for array in equations.states)
    slides = np.array([joint == "prismatic" for joint in needs.joints])
    rotated = np.tile([1 / 3, 2 / 3], (d, 1))
    slid = np.stack([np.full(d, 2 / 3), 1 / (3 * np.where(q > 0, q, 1.0) ** 2)], axis=1)
    pairs = np.where(slides[:, None], slid, rotated)
    rates = unit / np.where(qdd > 0, qdd, 1.0)
    ones, none = np.ones(bodies), np.zeros(bodies)
    scales = KernelScales(rates / rates.mean(), ones, pairs, *((ones, pairs) if needs.gravity else (None, None)))
    few = States(*(array[:: max(1, len(array) // FEW)] for array in equations.states))

    def size(scales: KernelScales) -> float:
        """Mean variance of torques in units of the measured ones; 1 if nothing moves."""
        variance = np.diagonal(compiled_covariance(needs.joints, serial)(scales, few)).reshape(-1, d)
        return float(np.mean(variance / unit**2)) or 1.0

    without = scales._replace(weight=none if needs.gravity else None)
    scales = scales._replace(inertia=ones * 0.5 / size(without))
    if needs.gravity:
        scales = scales._replace(weight=ones / size(scales._replace(inertia=none)))
    return jax.tree.map(np.log, scales)


@functools.lru_cache(maxsize=4)
def compiled_covariance(joints: tuple[JointKind, ...], serial: bool) -> Callable[..., Any]:
    """(scales, states) -> `torque_covariance`."""
    return jax.jit(
        lambda scales, states: torque_covariance(joints, serial, scales, states),
        compiler_options=quick_compilation(),
    )
