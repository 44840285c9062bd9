"""Conservative continuous collision detection: how far vertices may move until a pair nearly touches.

Additive advancement (Li, Kaufman, Jiang 2021, Codimensional Incremental Potential Contact, section 5): with the speed
bound l = max |p_i| + max |p_j| over the vertices of the two primitives (relative to their mean motion), the distance
after a time t is at least d - t l. Time advances by such bounds until the distance has shrunk to a fraction of its
initial value. The result never overestimates, apart from rounding, which is smaller than the remaining distance.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dln_jax.softbody.contact.distances import EDGE_EDGE, summed

REMAINING = 0.1
"""Fraction of its distance that a pair keeps in one step."""
_ADVANCE = 0.9
_ITERATIONS = 200


def speed_bound(p: Float[Array, "k dim"], kind: Int[Array, ""] | int) -> Float[Array, ""]:
    """Returns l in m per unit of time for one pair whose vertices move by p; kinds are those of `distances`."""
    speed = jnp.sqrt(summed((p - summed(p, axis=0) / len(p)) ** 2))
    first = jnp.arange(len(p)) < jnp.where((kind == EDGE_EDGE) & (len(p) == 4), 2, 1)
    return jnp.max(jnp.where(first, speed, 0)) + jnp.max(jnp.where(first, 0, speed))


def longest_step(
    distance: Callable[[Float[Array, " lanes"]], Float[Array, " lanes"]], bound: Float[Array, " lanes"]
) -> Float[Array, ""]:
    """Returns the largest t <= 1 up to which no lane has lost more than 1 - `REMAINING` of its distance.

    Args:
        distance: one time per lane -> distances in m.
        bound: upper bounds on the rates at which distances shrink, in m per unit of time; zero excludes a lane.
    """
    start = distance(jnp.zeros_like(bound))
    target = REMAINING * start
    # The other lanes keep enough distance however they move.
    moving = bound > start - target
    rate = jnp.where(moving, bound, 1.0)

    def more(state: tuple[Array, Array, Array, Array]) -> Array:
        _, active, _, count = state
        return active.any() & (count < _ITERATIONS)

    def advance(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        t, active, limit, count = state
        now = distance(t)
        reached = now <= target + (1 - _ADVANCE) * (start - target)
        limit = jnp.min(jnp.where(active & reached, t, limit), initial=1.0)
        active &= ~reached
        t = jnp.where(active, t + _ADVANCE * jnp.maximum(now - target, 0) / rate, t)
        # A lane beyond the earliest stop of another lane cannot shorten the step.
        return t, active & (t < limit), limit, count + 1

    one = jnp.ones((), start.dtype)
    # A lane that is still active after all iterations is free up to its t, like a lane that has stopped.
    t, *_ = jax.lax.while_loop(more, advance, (jnp.zeros_like(bound), moving, one, jnp.asarray(0)))
    return jnp.min(jnp.where(moving, t, 1.0), initial=1.0)
