"""The phases of `shoot`: searches for a minimum, escapes from saddles, and restoration.

If a search ends at a saddle, the next one starts beside it, along a direction of negative curvature of the Lagrangian.
If a search gives up with violated hard constraints, the next one minimises the sum of their violations, except for the
steps and the limits of controls and durations (the restoration phase of Wächter and Biegler 2006, section 3.3). If it
reaches a feasible point, the search for a minimum continues from there. If it converges elsewhere, the violation is
stationary and the problem is locally infeasible.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.control.conditions import Conditions, Inequalities
from dln_jax.control.interior_point import Search, Trial, search, started
from dln_jax.solvers.ending import Ending

RESTORING = 1e-6
"""Weight of the cost during the minimisation of violations, to choose between points of equal violation. Constraints
with multipliers below its inverse are met if possible."""
PRICE = 10.0
"""Price of state limits in the sum of violations; other constraints have price one."""
STATIONARY = 1e-6
"""Smallest tolerance for a minimum of the violations."""
MOST_ESCAPES, MOST_RESTORATIONS = 3, 2
WAY = 0.1
"""Length of the step away from a saddle, relative to one plus the largest state or control."""


class Phase(NamedTuple):
    """State between two searches."""

    x: Array
    u: Array
    restoring: Array
    escapes: Array
    restorations: Array
    iterations: Array
    last: Search
    weight: Array
    """Weight of the cost in the last search."""


def phases(
    of: Callable[[Array, Array], Conditions], trial: Trial, x: Array, u: Array, *, soft: tuple[Any, Any] | None,
    free: Any, iterations: int, tolerance: float,
) -> tuple[Search, Array]:  # fmt: skip
    """Runs all phases from states x [N+1, n] and controls u [N, m]; soft constraints have the weights w_1, w_2.

    `of` takes the weight of the cost, and one (zero if rows replace the equations of the end). Returns the last search
    and the weight of its cost.
    """
    kinds = of(jnp.ones(()), jnp.ones(())).kinds
    limited = kinds.soft & (soft is not None)
    hard = kinds.present & ~limited
    prices = jnp.where(kinds.soft | kinds.ends, 1.0, PRICE), 0.0

    def prepared(restoring: Array) -> tuple[Array, Conditions, Inequalities]:
        weight = jnp.where(restoring, RESTORING, 1.0)
        present = kinds.present & (restoring | ~kinds.ends)
        elastic = present & jnp.where(restoring, ~kinds.unknowns, limited)
        weights = (jnp.where(limited, weight * w, price) for w, price in zip(soft or (0.0, 0.0), prices, strict=True))
        rows = Inequalities(present, elastic, kinds.unknowns, *weights)
        return weight, of(weight, jnp.where(restoring, 0.0, 1.0)), rows

    def following(phase: Phase) -> Phase:
        restoring = phase.restoring
        weight, functions, rows = prepared(restoring)
        last = search(
            functions, rows, trial, started(functions, rows, phase.x, phase.u), free=free, iterations=iterations,
            tolerance=jnp.where(restoring, jnp.maximum(tolerance, STATIONARY), tolerance),
        )  # fmt: skip
        broken = jnp.max(jnp.where(hard, last.values.c, -jnp.inf), initial=0.0)
        met = jnp.maximum(broken, jnp.max(jnp.abs(last.values.defects))) <= jnp.sqrt(tolerance)
        saddle, given_up = last.ending == Ending.SADDLE, gave_up(last.ending)
        back = restoring & met & (last.ending != Ending.NOT_FINITE)
        escape = saddle & ~back & (phase.escapes < MOST_ESCAPES)
        restore = ~restoring & given_up & ~met & (phase.restorations < MOST_RESTORATIONS)
        infeasible = restoring & (last.ending == Ending.CONVERGED)
        ending = jnp.select(
            [escape | restore | back, infeasible, restoring & (given_up | saddle)],
            [Ending.UNDECIDED, Ending.INFEASIBLE, Ending.VIOLATED], last.ending,
        )  # fmt: skip
        far = (jnp.max(jnp.abs(d)) / (1 + jnp.max(jnp.abs(at))) for d, at in (
            (last.change.dx, last.at.x), (last.change.du, last.at.u)))  # fmt: skip
        beside = trial(last.at, last.change, WAY / jnp.maximum(*far))
        x, u = (jnp.where(escape, new, old) for new, old in zip(beside, (last.at.x, last.at.u), strict=True))
        return Phase(
            x, u, jnp.where(escape, restoring, restore), phase.escapes + escape, phase.restorations + restore,
            phase.iterations + last.iterations, last._replace(ending=ending), weight,
        )  # fmt: skip

    _, functions, rows = prepared(jnp.asarray(False))
    shapes, none = jax.eval_shape(lambda: started(functions, rows, x, u)), jnp.asarray(0)
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    empty = empty._replace(ending=jnp.asarray(Ending.UNDECIDED))
    begin = Phase(x, u, jnp.asarray(False), none, none, none, empty, jnp.ones((), x.dtype))
    phase = jax.lax.while_loop(lambda phase: phase.last.ending == Ending.UNDECIDED, following, begin)
    return phase.last._replace(iterations=phase.iterations), phase.weight


def gave_up(ending: Array) -> Array:
    """Returns whether a search ended without a verdict on its point."""
    return (ending == Ending.NO_DESCENT) | (ending == Ending.OUT_OF_ITERATIONS)
