"""A backtracking line search that still detects descent when rounding hides changes of the energy."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from dln_jax.solvers.elements.energies import Blocks

# Sufficient decrease of the line search (Armijo), and how often it halves the step.
_DECREASE = 1e-4
_HALVINGS = 40


class Evaluated(NamedTuple):
    """A point with its energy and gradient."""

    x: Blocks
    energy: Float[Array, ""]
    gradient: Blocks


class _LineSearchTrial(NamedTuple):
    point: Evaluated
    length: Float[Array, ""]
    accepted: Bool[Array, ""]


def line_search(
    evaluate: Callable[[Blocks], tuple[Float[Array, ""], Blocks]],
    start: Evaluated,
    direction: Blocks,
    slope: Float[Array, ""],
    unclear: Float[Array, ""],
    scale: Float[Array, "n 1"],
    *,
    longest: Float[Array, ""] | float = 1.0,
    any_change: Bool[Array, ""] | bool = False,
) -> tuple[Evaluated, Float[Array, ""]]:
    """Takes the first of the steps l, l/2, l/4, ... that lowers the energy, or the gradient if rounding hides that.

    Changes of the energy below `unclear` are rounding of terms that cancel at rest; the gradient of a stiff body keeps
    improving by many digits beyond that. Returns point and step length, or the start and 0 if no step is accepted.

    Args:
        evaluate: x -> energy and gradient.
        start: the point where the search starts.
        direction: a descent direction.
        slope: derivative of the energy along the direction, <= 0.
        unclear: size of energy changes that rounding hides.
        scale: unit of the gradient's rows.
        longest: the first length l.
        any_change: whether to accept any step to a finite energy.
    """

    def size(gradient: Blocks) -> Array:
        return jnp.max(jnp.abs(gradient) / scale, initial=0)

    before = size(start.gradient)

    def attempt(trial: _LineSearchTrial) -> _LineSearchTrial:
        x = start.x + trial.length * direction
        energy, gradient = evaluate(x)
        change = energy - start.energy
        lower = change <= _DECREASE * trial.length * slope
        flatter = (jnp.abs(change) <= unclear) & (size(gradient) < before)
        accepted = (lower | flatter | any_change) & jnp.isfinite(energy) & jnp.isfinite(gradient).all()
        return _LineSearchTrial(Evaluated(x, energy, gradient), trial.length / 2, accepted)

    first = jnp.asarray(longest, start.x.dtype)
    smallest = 2.0**-_HALVINGS * first
    last = jax.lax.while_loop(
        lambda trial: ~trial.accepted & (trial.length > smallest),
        attempt,
        _LineSearchTrial(start, first, jnp.asarray(False)),
    )
    kept = [jnp.where(last.accepted, new, old) for new, old in zip(last.point, start, strict=True)]
    return Evaluated(*kept), jnp.where(last.accepted, 2 * last.length, 0)
