"""Smooth Coulomb friction of vertices, lagged: normals and normal forces are those at the start of the step.

    D = mu lambda_n f(|u|),   u = (1 - n nᵀ)(x - x_n),   f(u) = u²/e - u³/(3 e²) for u < e,  u - e/3 beyond,

after Li et al. 2020 (Incremental Potential Contact, section 5), with their constant chosen such that f(0) = 0. The
force is mu lambda_n against the slip from the threshold speed e/dt on, and falls smoothly to zero below it: a block
that "sticks" on a slope creeps at less than the threshold. f is twice continuously differentiable. The slip e must be
well above the rounding of the positions: in float32, 1e-4 m for a body of a metre.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.terms.term import Context
from dln_jax.types import Scalar

# Squared slip over squared threshold, below which the cubic part of f is beyond rounding and its derivatives overflow.
_NO_SLIP = 1e-16


class Slip(NamedTuple):
    """What the friction of one vertex needs; [m, ...] for all."""

    start: Float[Array, "*m dim"]
    """Position x_n at the start of the step, in m."""
    normal: Float[Array, "*m dim"]
    """Unit normal n there."""
    force: Float[Array, "*m"]
    """Largest friction mu lambda_n, in N."""
    threshold: Float[Array, "*m"]
    """Slip e in a step from which friction is at its largest, in m."""


def lagged_slip(
    context: Context,
    start: Float[Array, "m dim"],
    normal: Float[Array, "m dim"],
    normal_force: Float[Array, " m"],
    coefficient: Float[Array, "..."],
    threshold_speed: float,
) -> Slip:
    """The data of friction for one step: a derivative of it goes through the lagged force and normal as well.

    A static solve (dt infinite) has no velocities: there is no friction in it.
    """
    moving = jnp.isfinite(context.dt)
    force = jnp.where(moving, coefficient * normal_force, 0.0)
    threshold = jnp.where(moving, threshold_speed * context.dt, 1.0)
    return Slip(start, normal, force, jnp.broadcast_to(threshold, force.shape))


def friction_energy(x: Sequence[Array] | Float[Array, " dim"], slip: Slip) -> Scalar:
    """D in J of one vertex."""
    axes = range(len(x))
    moved = [x[i] - slip.start[i] for i in axes]
    along = sum(moved[i] * slip.normal[i] for i in axes)
    squared = jnp.asarray(sum((moved[i] - along * slip.normal[i]) ** 2 for i in axes))
    return slip.force * _smooth_norm(squared, slip.threshold)


def _smooth_norm(squared: Scalar, threshold: Scalar) -> Scalar:
    """f(u), given u²."""
    ratio = squared / threshold**2
    slipping = ratio > _NO_SLIP
    root = jnp.sqrt(jnp.where(slipping, ratio, 1.0))
    cubic = jnp.where(slipping, ratio * root, 0.0)
    return threshold * jnp.where(ratio < 1.0, ratio - cubic / 3.0, root - 1.0 / 3.0)
