"""What a fitted model does not know: a standard deviation of its torque at any state, and whether a state is outside.

Parameters theta that were fitted are uncertain by Cov(theta) = F Fᵀ, and to first order (exactly, where forces are
linear in them) the torque of joint i at a state is uncertain by

    sd_i² = noise_i² + inflation_i |phi_i F|²,   phi_i = d tau_i / d theta

(MacKay 1992, "A practical Bayesian framework for backpropagation networks"; Immer et al. 2021, "Improving predictions
of Bayesian neural nets via local linearization"). `learning.uncertainty` finds all of it from data. Everything is for
one state.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.mechanics.arguments import answer, vectors
from dln_jax.models.linearisation import linearised
from dln_jax.models.model import Model, Parameters
from dln_jax.types import Vector

UNDETERMINED = 1e-3
"""Share of |phi|, in scaled parameters, in directions that data never showed, above which a state is outside."""


class Domain(NamedTuple):
    """Where the data were; d joints."""

    limit: Any
    """[d], |phi F| that the data stay below, N m or N."""
    scale: Any
    """[P], size of each column of Phi over the data; 1 for one that they never showed."""
    undetermined: Any
    """[P, P - rank], orthonormal directions of scaled parameters that the data leave undetermined; there are none of a
    network, whose prior determines them."""
    centre: Any
    """[3 d], middle of the range of (q, qd, qdd)."""
    reach: Any
    """[3 d], how far from the middle the data come."""
    harmless: Any
    """[d], |phi F| below which it does not matter that a state leaves the range of the data, N m or N. Zeros for
    networks, whose covariance alone cannot be trusted there."""


class Uncertainty(NamedTuple):
    """All that is stored of what a model does not know."""

    factor: Any
    """F [P, K]."""
    noise: Any
    """[d], standard deviation of what no parameters explain, N m or N."""
    inflation: Any
    """[d], of the parameters' share; 1 where errors are independent."""
    domain: Domain


class Scores(NamedTuple):
    """How far outside a state is, each 1 at its threshold."""

    parameters: Array
    """[], standard deviation by the parameters, over the data's; the joint's where that is largest."""
    undetermined: Array
    """[], share of Phi in directions that the data leave undetermined, over `UNDETERMINED`."""
    distance: Array
    """[], from the middle of the range of (q, qd, qdd), over its reach; the coordinate's where that is largest. 0 where
    every joint's deviation by the parameters is below `Domain.harmless`."""


def predictive(
    model: Model, parameters: Parameters, factor: Any, noise: Any = 0.0, inflation: Any = 1.0
) -> Callable[[Any, Any, Any], Array]:
    """(q, qd, qdd) -> standard deviation of the torque [d] at one state, N m or N.

    Args:
        model: that was fitted.
        parameters: as they were found.
        factor: F [P, K] of their covariance, in the order of `ravel_pytree(parameters)`.
        noise: standard deviation of one measurement [d]; zero for that of the model's own torque.
        inflation: of the parameters' share, [d].
    """

    d = np.size(noise) if np.ndim(noise) else None

    def torque_std(q: Any, qd: Any, qdd: Any) -> Array:
        rows, _ = answer(partial(linearised, model, parameters), *vectors(d, q=q, qd=qd, qdd=qdd))
        return _deviation(rows, factor, noise, inflation)

    return torque_std


def torque_deviation(rows: Float[Array, "d P"], uncertainty: Uncertainty) -> Vector:
    """Standard deviation of the torque [d] at a state with Phi = `rows`, N m or N."""
    return _deviation(rows, uncertainty.factor, uncertainty.noise, uncertainty.inflation)


def _deviation(rows: Float[Array, "d P"], factor: Any, noise: Any, inflation: Any) -> Vector:
    noises, inflations = (jnp.asarray(each, rows.dtype) for each in (noise, inflation))
    return jnp.sqrt(noises**2 + inflations * parameter_variance(rows, factor))


def scores(model: Model, parameters: Parameters, uncertainty: Uncertainty) -> Callable[[Any, Any, Any], Scores]:
    """(q, qd, qdd) -> how far outside the data a state is, in three ways, each 1 at its threshold."""

    def of_state(q: Any, qd: Any, qdd: Any) -> Scores:
        state = vectors(len(uncertainty.noise), q=q, qd=qd, qdd=qdd)
        rows, _ = linearised(model, parameters, *state)
        return scores_of_rows(rows, state, uncertainty)

    return of_state


def scores_of_rows(rows: Float[Array, "d P"], state: Sequence[Vector], uncertainty: Uncertainty) -> Scores:
    """`scores` of a state (q, qd, qdd) with Phi = `rows`."""
    domain = uncertainty.domain
    limit, centre, reach, harmless = (
        jnp.asarray(each, rows.dtype) for each in (domain.limit, domain.centre, domain.reach, domain.harmless)
    )
    deviation = jnp.sqrt(parameter_variance(rows, uncertainty.factor))
    distance = jnp.max(jnp.abs(jnp.concatenate(state) - centre) / reach)
    return Scores(
        parameters=jnp.max(deviation / limit),
        undetermined=jnp.sqrt(jnp.max(undetermined_share(rows, domain))) / UNDETERMINED,
        distance=jnp.where(jnp.any(deviation >= harmless), distance, 0),
    )


def highest(of_state: Scores) -> Array:
    """[], the largest score; NaN if one is."""
    return jnp.max(jnp.stack(of_state))


def outside(model: Model, parameters: Parameters, uncertainty: Uncertainty) -> Callable[[Any, Any, Any], Array]:
    """(q, qd, qdd) -> whether a state is outside the data: one of its `scores` is above 1, or not a number."""
    of_state = scores(model, parameters, uncertainty)

    def is_outside(q: Any, qd: Any, qdd: Any) -> Array:
        return ~(highest(of_state(q, qd, qdd)) <= 1)

    return is_outside


def parameter_variance(rows: Float[Array, "d P"], factor: Any) -> Vector:
    """|phi F|² of each joint [d], (N m)² or N²."""
    return jnp.sum((rows @ jnp.asarray(factor, rows.dtype)) ** 2, axis=1)


def undetermined_share(rows: Float[Array, "d P"], domain: Domain) -> Vector:
    """Of |phi|² of each joint, in scaled parameters, what is in undetermined directions [d], 0 to 1."""
    directions = jnp.asarray(domain.undetermined, rows.dtype)
    if directions.shape[1] == 0:
        return jnp.zeros(rows.shape[0], rows.dtype)
    scaled = rows / jnp.asarray(domain.scale, rows.dtype)
    whole = jnp.sum(scaled**2, axis=1)
    return jnp.sum((scaled @ directions) ** 2, axis=1) / jnp.where(whole > 0, whole, 1)
