"""Uncertainty of a fitted model: a standard deviation of the torque at any state, and an out-of-distribution test.

Fitted parameters theta have the covariance Cov(theta) = F Fᵀ. To first order (exactly, if forces are linear in them)
the torque of joint i at a state has the standard deviation

    sd_i² = noise_i² + inflation_i |phi_i F|²,   phi_i = d tau_i / d theta

(MacKay 1992, "A practical Bayesian framework for backpropagation networks"; Immer et al. 2021, "Improving predictions
of Bayesian neural nets via local linearization"). `learning.uncertainty` estimates the covariance, noise and inflation.
Functions take one state.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.models.model import Model, Parameters, linearised
from dln_jax.types import Vector

UNDETERMINED = 1e-3
"""Largest accepted share of |phi|, in scaled parameters, along directions that the data do not determine."""


class Domain(NamedTuple):
    """Range of the data; d joints."""

    limit: Any
    """[d], bound on |phi F| over the data, N m or N."""
    scale: Any
    """[P], sizes of the columns of Phi over the data; 1 for zero columns."""
    undetermined: Any
    """[P, P - rank], orthonormal directions of scaled parameters that the data do not determine; empty for networks,
    which have a prior."""
    centre: Any
    """[3 d], middle of the range of (q, qd, qdd)."""
    reach: Any
    """[3 d], largest distances of the data from the middle."""
    harmless: Any
    """[d], N m or N: while |phi F| is below it, a state may leave the range of the data. Zero for networks: their
    covariance alone is not reliable there."""


class Uncertainty(NamedTuple):
    """Stored uncertainty of a model."""

    factor: Any
    """F [P, K]."""
    noise: Any
    """[d], standard deviation of the noise, N m or N."""
    inflation: Any
    """[d], factor on the variance of the parameters; 1 if errors are independent."""
    domain: Domain


class Scores(NamedTuple):
    """Scores of a state; a state with a score above 1 is out of distribution."""

    parameters: Array
    """[], standard deviation due to parameters, relative to its bound on the data; the maximum over joints."""
    undetermined: Array
    """[], share of Phi along directions that the data do not determine, relative to `UNDETERMINED`."""
    distance: Array
    """[], distance from the middle of the range of (q, qd, qdd), relative to its reach; the maximum over coordinates. 0
    if the deviation due to parameters is below `Domain.harmless` in all joints."""


def predictive(
    model: Model, parameters: Parameters, factor: Any, noise: Any = 0.0, inflation: Any = 1.0
) -> Callable[[Any, Any, Any], Array]:
    """Returns (q, qd, qdd) -> standard deviation of the torque [d] at one state, N m or N.

    Args:
        factor: F [P, K] of the covariance of the parameters, in the order of `ravel_pytree(parameters)`.
        noise: standard deviation of one measurement [d]; zero for the deviation of the model's own torque.
        inflation: factor on the variance due to parameters, [d].
    """
    d = np.size(noise) if np.ndim(noise) else None

    def torque_std(q: Any, qd: Any, qdd: Any) -> Array:
        rows, _ = answer(partial(linearised, model, parameters), *vectors(d, q=q, qd=qd, qdd=qdd))
        return deviation_of_rows(rows, factor, noise, inflation)

    return torque_std


def deviation_of_rows(rows: Float[Array, "d P"], factor: Any, noise: Any, inflation: Any) -> Vector:
    """Returns the standard deviation of the torque [d] at a state with Phi = `rows`, N m or N."""
    noise, inflation = (jnp.asarray(array, rows.dtype) for array in (noise, inflation))
    return jnp.sqrt(noise**2 + inflation * _parameter_variance(rows, factor))


def _parameter_variance(rows: Float[Array, "d P"], factor: Any) -> Vector:
    """Returns |phi F|² of the joints [d], (N m)² or N²."""
    return jnp.sum((rows @ jnp.asarray(factor, rows.dtype)) ** 2, axis=1)


def scores(model: Model, parameters: Parameters, uncertainty: Uncertainty) -> Callable[[Any, Any, Any], Scores]:
    """Returns (q, qd, qdd) -> the three scores of a state, 1 at their thresholds."""

    def of_state(q: Any, qd: Any, qdd: Any) -> Scores:
        state = vectors(len(uncertainty.noise), q=q, qd=qd, qdd=qdd)
        rows, _ = linearised(model, parameters, *state)
        return scores_of_rows(rows, state, uncertainty)

    return of_state


def scores_of_rows(rows: Float[Array, "d P"], state: Sequence[Vector], uncertainty: Uncertainty) -> Scores:
    """Returns the `scores` of a state (q, qd, qdd) with Phi = `rows`."""
    limit, scale, directions, centre, reach, harmless = (jnp.asarray(x, rows.dtype) for x in uncertainty.domain)
    deviation = jnp.sqrt(_parameter_variance(rows, uncertainty.factor))
    distance = jnp.max(jnp.abs(jnp.concatenate(state) - centre) / reach)
    share = jnp.zeros(rows.shape[0], rows.dtype)
    if directions.shape[1] > 0:
        squares = jnp.sum((rows / scale) ** 2, axis=1)
        share = jnp.sum((rows / scale @ directions) ** 2, axis=1) / jnp.where(squares > 0, squares, 1)
    return Scores(
        parameters=jnp.max(deviation / limit),
        undetermined=jnp.sqrt(jnp.max(share)) / UNDETERMINED,
        distance=jnp.where(jnp.any(deviation >= harmless), distance, 0),
    )


def exceeds(of_state: Scores) -> Array:
    """Returns whether a state with these scores is out of distribution: one of them is above 1 or NaN."""
    return ~(jnp.max(jnp.stack(of_state)) <= 1)


def out_of_distribution(
    model: Model, parameters: Parameters, uncertainty: Uncertainty
) -> Callable[[Any, Any, Any], Array]:
    """Returns (q, qd, qdd) -> whether a state is out of distribution: one of its `scores` is above 1 or NaN."""
    of_state = scores(model, parameters, uncertainty)
    return lambda q, qd, qdd: exceeds(of_state(q, qd, qdd))
