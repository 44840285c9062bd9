"""The interior-point method of `shoot`.

Riccati's recursion solves Newton steps on the optimality conditions while the barrier μ falls to zero (Fiacco and
McCormick 1968). As in IPOPT (Wächter and Biegler 2006, with its constants), a filter of violation and barrier function
accepts steps. If the longest step raises the violation, a second-order correction is tried. The Hessian is damped until
the pivots of the recursion are positive. The damping carries over to the next step, and rises if no step is accepted.

If inequalities shorten several steps in a row, or no step is accepted, slacks are widened. The inequalities may then be
violated on the way, except for limits of controls and durations. A stationary point counts as a minimum if its undamped
pivots are positive. At a saddle, the last step follows a direction of negative curvature of the Lagrangian (by an
inverse iteration from noise).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.conditions import (
    Conditions,
    Inequalities,
    Iterate,
    Residuals,
    Values,
    gaps,
    guarded,
    inside,
    measure,
    newton,
    residuals,
    slope,
    to_boundary,
)
from dln_jax.control.riccati import HorizonSolution
from dln_jax.solvers.ending import Ending

FIRST_BARRIER, BARRIER_FACTOR, BARRIER_POWER, BARRIER_RATIO = 0.1, 0.2, 1.5, 10.0
FIRST_SLACK = 1e-2
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-20, 1e12
TO_BOUNDARY = 0.99
"""Largest share of the way to the boundary in a step; it grows as μ falls."""
VIOLATION_MARGIN, BARRIER_MARGIN, ARMIJO = 1e-5, 1e-8, 1e-8
SMALL_VIOLATION, LARGE_VIOLATION = 1e-4, 1e4
"""Limits of the violation relative to the first one. Below the small limit the barrier function must fall; the large
limit is never exceeded."""
MULTIPLIER_SPREAD = 1e10
"""Largest ratio of s z to μ, and of μ to s z."""
MOST_HALVINGS = 24
FILTER = 64
"""Largest number of pairs in the filter; the oldest are dropped."""
SHORT, MOST_SHORT, MOST_RELEASES = 0.02, 4, 10
"""Length of a step that counts as short, number of short or failed steps in a row before slacks are widened, and
largest number of such widenings."""
CURVATURE = 1e-6
"""Negative curvature up to this counts as zero; relative to the largest second derivative if it exceeds one."""
ROUNDING = 2.2e-16


class Search(NamedTuple):
    """State of the method."""

    at: Iterate
    values: Values
    change: HorizonSolution
    """The last step; the plan takes its gains."""
    barrier: Array
    damping: Array
    """Last damping needed."""
    least: Array
    """Initial damping of the next step: positive after a failed search."""
    filter: Array
    entries: Array
    largest: Array
    """Largest accepted violation."""
    short: Array
    """Number of short or failed steps in a row."""
    releases: Array
    iterations: Array
    residuals: Residuals
    ending: Array


Trial = Callable[[Iterate, HorizonSolution, Array], tuple[Array, Array]]
"""(iterate, change, length) -> x, u."""


def search(
    of: Conditions, rows: Inequalities, trial: Trial, start: Search, *, free: Any, iterations: int, tolerance: Any
) -> Search:
    """Runs the method from `started`."""
    present, (steps, m, n) = rows.present, start.change.K.shape
    random = np.random.default_rng(0)
    noise, end_noise = random.normal(size=(steps, n + m)), random.normal(size=n)

    def damped(solve: Callable[[Array], Any], search: Search, done: Array, bent: Array) -> tuple[Any, Array]:
        """Raises the damping until the step leads to a minimum of its quadratic program."""
        again = jnp.maximum(search.damping / 3, LEAST_DAMPING)
        first = jnp.where(done, bent, jnp.where(search.damping > 0, again, FIRST_DAMPING))
        growth = jnp.where(search.damping > 0, 8.0, 100.0)

        def more(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
            _, damping, number = carry
            raised = jnp.where(damping > 0, growth * damping, first)
            damping = jnp.where(number == 0, search.least, raised)
            return solve(damping), damping, number + 1

        def wanted(carry: tuple[Any, Array, Array]) -> Array:
            return ~carry[0][0].convex & (carry[1] < MOST_DAMPING)

        # The loop starts without a solution, so the step is compiled once.
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(solve, search.least))
        return jax.lax.while_loop(wanted, more, (none, search.least, jnp.asarray(0)))[:2]

    def moved(search: Search, change: HorizonSolution, step: Iterate, length: Array, length_z: Array) -> Iterate:
        at = search.at
        x, u = trial(at, change, length)
        s, t = at.s + length * step.s, at.t + length * step.t
        z, y = at.z + length_z * step.z, at.y + length_z * step.y
        return Iterate(x, u, at.prices + length * step.prices, at.nu + length * step.nu, s, z, t, y)

    def body(search: Search) -> Search:
        at, values = search.at, search.values
        slopes = of.slopes(at.x, at.u)
        curved = of.curvatures(at.x, at.u, at.prices, at.z, at.nu)
        plain, scaled = residuals(rows, at, values, slopes, 0.0, free)
        done = scaled.largest() <= tolerance

        def reached(barrier: Array) -> Array:
            close = residuals(rows, at, values, slopes, barrier, free)[1].largest() <= BARRIER_RATIO * barrier
            return close & (barrier > tolerance / 10) & ~done

        def lower(barrier: Array) -> Array:
            return jnp.maximum(tolerance / 10, jnp.minimum(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))

        barrier = jax.lax.while_loop(reached, lower, search.barrier)
        entries = jnp.where(barrier < search.barrier, 0, search.entries)
        share = jnp.maximum(TO_BOUNDARY, 1 - barrier)
        gap = gaps(rows, at, values)

        # After convergence, the step only searches for a direction of negative curvature.
        pulls = slopes._replace(cost=jnp.where(done, noise, slopes.cost),
                                end_cost=jnp.where(done, end_noise, slopes.end_cost))  # fmt: skip
        bent = CURVATURE * jnp.maximum(1.0, jnp.max(jnp.abs(curved[0])))

        def solve(damping: Array) -> Any:
            return newton(rows, at, pulls, curved, barrier, values, gap, damping, free)

        (change, step), damping = damped(solve, search._replace(least=jnp.where(done, 0.0, search.least)), done, bent)
        violation, phi = measure(rows, at, values, barrier)
        fall = slope(rows, at, slopes, step, barrier)
        slack = 10 * ROUNDING * jnp.abs(phi)
        tiny = 10 * ROUNDING * (1 + jnp.max(jnp.abs(at.x)) + jnp.max(jnp.abs(at.u)))
        small = jnp.maximum(jnp.max(jnp.abs(change.dx)), jnp.max(jnp.abs(change.du))) <= tiny
        pairs = jnp.where((jnp.arange(FILTER) < entries)[:, None], search.filter, jnp.inf)

        first, length_z = to_boundary(rows, at, step, share)

        def judged(change: HorizonSolution, step: Iterate, length: Array) -> Any:
            new = moved(search, change, step, length, length_z)
            at_new = of.values(new.x, new.u)
            violation_new, phi_new = measure(rows, new, at_new, barrier)
            descends = (fall < 0) & (length * jnp.maximum(-fall, 0.0) ** 2.3 > violation**1.1)
            descends &= violation <= SMALL_VIOLATION / LARGE_VIOLATION * search.largest
            enough = phi_new <= phi + ARMIJO * length * fall + slack
            better = (violation_new <= (1 - VIOLATION_MARGIN) * violation) | (
                phi_new <= phi - BARRIER_MARGIN * violation + slack
            )
            outside = (violation_new >= pairs[:, 0]) & (phi_new > pairs[:, 1] + slack)
            good = jnp.where(descends, enough, better) & ~outside.any() & (violation_new <= search.largest)
            return new, at_new, (good | small) & jnp.isfinite(phi_new), descends & enough, violation_new

        def attempt(carry: Any) -> Any:
            """Tries the longest step, then its second-order correction if the violation rose, then shorter steps."""
            (before, at_before, _, _, violation_before), length, number = carry
            correct = (number == 1) & (violation_before >= violation)

            def corrected() -> Any:
                summed = jax.tree.map(lambda then, now: first * then + now, values, at_before)
                gap_summed = first * gap + gaps(rows, before, at_before)
                return newton(rows, at, slopes, curved, barrier, summed, gap_summed, damping, free)

            other, other_step = jax.lax.cond(correct, corrected, lambda: (change, step))
            length = jnp.where(correct | (number == 0), length, length / 2)
            longest = to_boundary(rows, at, other_step, share)[0]
            return judged(other, other_step, jnp.where(correct, longest, length)), length, number + 1

        def unfinished(carry: Any) -> Array:
            return ~carry[0][2] & (carry[1] > first * 2.0**-MOST_HALVINGS) & ~done

        untried = (at, values, jnp.asarray(False), jnp.asarray(False), violation), first, jnp.asarray(0)
        (new, at_new, good, descended, _), _, _ = jax.lax.while_loop(unfinished, attempt, untried)
        good &= change.convex
        new = guarded(rows, new, barrier, MULTIPLIER_SPREAD)
        # A step that is accepted without enough descent of the barrier function adds a pair to the filter.
        keep = good & ~descended
        pair = jnp.stack([(1 - VIOLATION_MARGIN) * violation, phi - BARRIER_MARGIN * violation])
        filtered = jnp.where(keep, search.filter.at[entries % FILTER].set(pair), search.filter)
        raised = jnp.maximum(jnp.maximum(damping, search.damping) * 10, FIRST_DAMPING)
        short = jnp.where(good & (first > SHORT), 0, search.short + 1)
        release = (short >= MOST_SHORT) & ~done
        releases = search.releases + release
        lost = ~jnp.isfinite(plain.largest())
        spent = search.iterations + 1 >= iterations
        conditions = [lost, done & (damping > bent), done, releases > MOST_RELEASES, spent]
        outcomes = [Ending.NOT_FINITE, Ending.SADDLE, Ending.CONVERGED, Ending.NO_DESCENT, Ending.OUT_OF_ITERATIONS]
        ending = jnp.select(conditions, outcomes, Ending.UNDECIDED)
        at, values = jax.tree.map(
            lambda new, old: jnp.where(good & ~done, new, old), (new, at_new), (search.at, search.values)
        )
        used = jnp.where(damping > 0, damping, search.damping)
        after = Search(
            at, values, change, barrier, jnp.where(good, used, raised), jnp.where(good, 0.0, raised), filtered,
            entries + keep, search.largest, short, releases, search.iterations + ~done, plain, ending,
        )  # fmt: skip
        # Depth below zero of the slacks after the whole step.
        wanted = jnp.max(jnp.where(present & ~rows.strict, -(search.at.s + step.s), 0.0), initial=0.0)
        return jax.lax.cond(release, released, lambda after, _: after, after, wanted)

    def released(search: Search, width: Array) -> Search:
        """Widens the slacks, so that inequalities may be violated on the way unless strict, and starts again."""
        at = search.at
        s = jnp.where(present & ~rows.strict, jnp.maximum(at.s, jnp.clip(width, 1e-1, 1e2)), at.s)
        z = jnp.where(present, jnp.minimum(FIRST_BARRIER / s, 1.0), 0.0)
        y = jnp.where(rows.elastic, FIRST_BARRIER / at.t, 0.0)
        at = at._replace(prices=0 * at.prices, nu=0 * at.nu, s=s, z=z, y=y)
        return _begun(rows, search._replace(at=at))

    return jax.lax.while_loop(lambda search: search.ending == Ending.UNDECIDED, body, start)


def started(of: Conditions, rows: Inequalities, x: Array, u: Array) -> Search:
    """Returns the start of a search at states x [N+1, n] and controls u [N, m]."""
    values = of.values(x, u)
    at = inside(rows, values, x, u, FIRST_SLACK)
    zero, none, K = jnp.zeros((), x.dtype), jnp.asarray(0), jnp.zeros((*u.shape, x.shape[1]), x.dtype)
    change = HorizonSolution(jnp.zeros_like(x), jnp.zeros_like(u), K, at.prices, jnp.asarray(True))
    return _begun(rows, Search(
        at, values, change, zero, zero, zero, jnp.zeros((FILTER, 2), x.dtype), none, zero, none, none, none,
        Residuals(zero, zero, zero), jnp.asarray(Ending.UNDECIDED),
    ))  # fmt: skip


def _begun(rows: Inequalities, search: Search) -> Search:
    barrier = jnp.full_like(search.barrier, FIRST_BARRIER)
    largest = LARGE_VIOLATION * jnp.maximum(measure(rows, search.at, search.values, barrier)[0], 1.0)
    none, zero = jnp.zeros_like(search.entries), jnp.zeros_like(barrier)
    return search._replace(barrier=barrier, damping=zero, least=zero, entries=none, short=none, largest=largest)
