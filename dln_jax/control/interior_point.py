"""The interior-point method of `shoot` and `optimise`.

Inequalities c - t + s = 0 have slacks s > 0; those that are soft have an excess t > 0 that costs w_1 t + w_2 t² / 2.
Newton steps on the conditions of an optimum with s z = μ and t y = μ are solved by Riccati's recursion, while μ falls
to zero (Fiacco and McCormick 1968). As in IPOPT (Wächter and Biegler 2006, with its constants), a filter of violation
and barrier function accepts a step, after a second-order correction where a full step raises the violation, and the
Hessian is damped until the recursion's pivots are positive. The damping has a memory. A search that finds no step
raises it, and where that is not enough the filter is emptied: there is no phase of restoration.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.control.conditions import Conditions, Slopes, Values, along, program, stationarity
from dln_jax.control.riccati import HorizonSolution, least_cost
from dln_jax.solvers.ending import Ending

FIRST_BARRIER, BARRIER_FACTOR, BARRIER_POWER, BARRIER_RATIO = 0.1, 0.2, 1.5, 10.0
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-20, 1e12
TO_BOUNDARY = 0.99
"""Share of the way to the boundary that a step may go, at least."""
VIOLATION_MARGIN, BARRIER_MARGIN, ARMIJO = 1e-5, 1e-8, 1e-8
SMALL_VIOLATION, LARGE_VIOLATION = 1e-4, 1e4
"""Violations relative to the first: below one the barrier function has to fall, above the other no step is accepted."""
MULTIPLIER_SPREAD = 1e10
"""Largest ratio of s z to μ, and of μ to s z."""
MOST_HALVINGS = 24
FILTER = 64
"""Number of remembered pairs; the oldest are forgotten."""
SHORT, MOST_SHORT, MOST_RELEASES = 0.02, 4, 10
"""Length below which a step counts as cut short by inequalities, number of such or failed steps in a row after which
slacks are widened, and number of times that this is done."""
END_COMPLIANCE = 1e-8
"""Compliance of the equations of the end in the linear systems; it does not change the solution."""
ROUNDING = 2.2e-16


class Iterate(NamedTuple):
    """Unknowns and multipliers."""

    x: Array
    u: Array
    prices: Array
    """λ [N, n]."""
    nu: Array
    s: Array
    z: Array
    t: Array
    y: Array


class Residuals(NamedTuple):
    """Residuals of the conditions, largest absolute values."""

    stationarity: Array
    feasibility: Array
    complementarity: Array


class Search(NamedTuple):
    """State of the method."""

    at: Iterate
    values: Values
    K: Array
    barrier: Array
    damping: Array
    """Memory of the damping that was needed last."""
    least: Array
    """Damping from which the next step starts: positive after a failed search."""
    filter: Array
    entries: Array
    largest: Array
    """Largest violation that is accepted."""
    short: Array
    """Number of short or failed steps in a row."""
    releases: Array
    iterations: Array
    residuals: Residuals
    ending: Array


Trial = Callable[[Iterate, HorizonSolution, Array], tuple[Array, Array]]
"""(iterate, change, length) -> x, u."""


def straight(at: Iterate, change: HorizonSolution, length: Array) -> tuple[Array, Array]:
    """The trial of multiple shooting: states and controls move along the change."""
    return at.x + length * change.dx, at.u + length * change.du


def search(
    of: Conditions, trial: Trial, x: Array, u: Array, *, soft: tuple[Any, Any] | None, free: Any,
    iterations: int, tolerance: float,
) -> Search:  # fmt: skip
    """Runs the method from states x [N+1, n] and controls u [N, m]; soft constraints have the weights w_1, w_2."""
    present = of.kinds.present
    elastic = of.kinds.soft & present if soft is not None else None
    linear, square = soft if soft is not None else (0.0, 0.0)

    def excess_cost(t: Array) -> Array:
        return jnp.where(elastic, linear * t + square * t**2 / 2, 0.0) if elastic is not None else jnp.zeros_like(t)

    def logs(distance: Array, mask: Array) -> Array:
        return jnp.sum(jnp.where(mask, jnp.log(distance), 0.0))

    def gaps(at: Iterate, values: Values) -> Array:
        return jnp.where(present, values.c + at.s - at.t, 0.0)

    def measure(at: Iterate, values: Values, barrier: Array) -> tuple[Array, Array]:
        """Violation, and barrier function."""
        every = [values.defects.ravel(), values.h, gaps(at, values)]
        violation = jnp.sum(jnp.abs(jnp.concatenate(every)))
        phi = values.cost + jnp.sum(excess_cost(at.t)) - barrier * logs(at.s, present)
        if elastic is not None:
            phi = phi - barrier * logs(at.t, elastic)
        return violation, jnp.where(jnp.isfinite(phi), phi, jnp.inf)

    def of_excess(at: Iterate) -> Array:
        """Derivative of L by t."""
        if elastic is None:
            return jnp.zeros_like(at.t)
        return jnp.where(elastic, linear + square * at.t - at.z - at.y, 0.0)

    def residuals(at: Iterate, values: Values, slopes: Slopes, barrier: Any) -> tuple[Residuals, Residuals]:
        """Residuals at a barrier, plain and scaled by the size of the multipliers."""
        gradient = jnp.append(stationarity(slopes, at.prices, at.z, at.nu, free), of_excess(at))
        both = jnp.concatenate([values.defects.ravel(), values.h, gaps(at, values)])
        products = jnp.concatenate([jnp.where(present, at.s * at.z - barrier, 0.0), _tied(at, elastic, barrier)])
        plain = Residuals(*(jnp.max(jnp.abs(r), initial=0.0) for r in (gradient, both, products)))
        duals = jnp.sum(at.z) + jnp.sum(at.y)
        inequalities = jnp.maximum(jnp.sum(present), 1)
        every = jnp.sum(jnp.abs(at.prices)) + jnp.sum(jnp.abs(at.nu)) + duals
        scale = jnp.maximum(every / (at.prices.size + at.nu.size + inequalities) / 100, 1.0)
        scale_z = jnp.maximum(duals / inequalities / 100, 1.0)
        return plain, Residuals(plain[0] / scale, plain[1], plain[2] / scale_z)

    def largest(residuals: Residuals) -> Array:
        return jnp.maximum(jnp.maximum(*residuals[:2]), residuals[2])

    def change_at(
        at: Iterate,
        slopes: Slopes,
        curved: tuple[Array, Array],
        barrier: Array,
        missed: Values,
        gap: Array,
        damping: Any,
    ) -> tuple[HorizonSolution, Iterate]:
        """Returns the Newton step as a solution of the program, and as a change of the iterate."""
        stiff = at.z / at.s
        drive = jnp.where(present, barrier / at.s, 0.0) - at.z + stiff * gap
        give, off = jnp.zeros_like(at.t), jnp.zeros_like(at.t)
        if elastic is not None:
            give = jnp.where(elastic, 1 / (square + at.y / at.t), 0.0)
            off = jnp.where(elastic, linear + square * at.t - at.z - barrier / at.t, 0.0)
        softer = 1 + stiff * give
        drive, stiff_soft = (drive + stiff * give * off) / softer, stiff / softer
        horizon = program(slopes, curved, at.z + drive, stiff_soft, missed.defects, damping)
        horizon = horizon._replace(
            end_gradient=horizon.end_gradient + slopes.h.T @ (at.nu + missed.h / END_COMPLIANCE),
            end_curvature=horizon.end_curvature + slopes.h.T @ slopes.h / END_COMPLIANCE,
        )
        change = least_cost(horizon, free)
        _, of_c, of_h = along(slopes, change.dx, change.du)
        dz = drive + stiff_soft * of_c
        dt = give * (dz - off)
        ds = dt - gap - of_c
        dy = jnp.zeros_like(dt) if elastic is None else jnp.where(elastic, (barrier - at.y * dt) / at.t - at.y, 0.0)
        dnu = (missed.h + of_h) / END_COMPLIANCE
        return change, Iterate(change.dx, change.du, change.multipliers - at.prices, dnu, ds, dz, dt, dy)

    def damped(solve: Callable[[Array], Any], search: Search) -> tuple[Any, Array]:
        """Raises the damping until the step is that of a minimum."""
        again = jnp.maximum(search.damping / 3, LEAST_DAMPING)
        first = jnp.where(search.damping > 0, again, FIRST_DAMPING)
        growth = jnp.where(search.damping > 0, 8.0, 100.0)

        def more(carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
            _, damping, number = carry
            raised = jnp.where(damping > 0, growth * damping, first)
            damping = jnp.where(number == 0, search.least, raised)
            return solve(damping), damping, number + 1

        def wanted(carry: tuple[Any, Array, Array]) -> Array:
            return ~carry[0][0].convex & (carry[1] < MOST_DAMPING)

        # Without a first solution, so that the step is compiled once.
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(solve, search.least))
        return jax.lax.while_loop(wanted, more, (none, search.least, jnp.asarray(0)))[:2]

    def longest(value: Array, change: Array, mask: Array, share: Array) -> Array:
        fastest = jnp.max(jnp.where(mask, -change / value, 0.0), initial=0.0)
        return jnp.minimum(1.0, share / jnp.maximum(fastest, 1e-30))

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
        plain, scaled = residuals(at, values, slopes, 0.0)
        done = largest(scaled) <= tolerance

        def reached(barrier: Array) -> Array:
            close = largest(residuals(at, values, slopes, barrier)[1]) <= BARRIER_RATIO * barrier
            return close & (barrier > tolerance / 10) & ~done

        def lower(barrier: Array) -> Array:
            return jnp.maximum(tolerance / 10, jnp.minimum(BARRIER_FACTOR * barrier, barrier**BARRIER_POWER))

        barrier = jax.lax.while_loop(reached, lower, search.barrier)
        entries = jnp.where(barrier < search.barrier, 0, search.entries)
        share = jnp.maximum(TO_BOUNDARY, 1 - barrier)
        gap = gaps(at, values)

        def solve(damping: Array) -> Any:
            return change_at(at, slopes, curved, barrier, values, gap, damping)

        (change, step), damping = damped(solve, search)
        violation, phi = measure(at, values, barrier)
        fall = along(slopes, change.dx, change.du)[0] - barrier * jnp.sum(jnp.where(present, step.s / at.s, 0.0))
        if elastic is not None:
            by_t = jnp.where(elastic, (linear + square * at.t - barrier / at.t) * step.t, 0.0)
            fall = fall + jnp.sum(by_t)
        slack = 10 * ROUNDING * jnp.abs(phi)
        tiny = 10 * ROUNDING * (1 + jnp.max(jnp.abs(at.x)) + jnp.max(jnp.abs(at.u)))
        small = jnp.maximum(jnp.max(jnp.abs(change.dx)), jnp.max(jnp.abs(change.du))) <= tiny
        pairs = jnp.where((jnp.arange(FILTER) < entries)[:, None], search.filter, jnp.inf)

        def longest_of(step: Iterate) -> Array:
            length = longest(at.s, step.s, present, share)
            return length if elastic is None else jnp.minimum(length, longest(at.t, step.t, elastic, share))

        length_z = longest(at.z, step.z, present, share)
        if elastic is not None:
            length_z = jnp.minimum(length_z, longest(at.y, step.y, elastic, share))

        def judged(change: HorizonSolution, step: Iterate, length: Array) -> Any:
            new = moved(search, change, step, length, length_z)
            at_new = of.values(new.x, new.u)
            violation_new, phi_new = measure(new, at_new, barrier)
            descends = (fall < 0) & (length * jnp.maximum(-fall, 0.0) ** 2.3 > violation**1.1)
            descends &= violation <= SMALL_VIOLATION / LARGE_VIOLATION * search.largest
            enough = phi_new <= phi + ARMIJO * length * fall + slack
            better = (violation_new <= (1 - VIOLATION_MARGIN) * violation) | (
                phi_new <= phi - BARRIER_MARGIN * violation + slack
            )
            outside = (violation_new >= pairs[:, 0]) & (phi_new > pairs[:, 1] + slack)
            good = jnp.where(descends, enough, better) & ~outside.any() & (violation_new <= search.largest)
            return new, at_new, (good | small) & jnp.isfinite(phi_new), descends & enough, violation_new

        first = longest_of(step)

        def attempt(carry: Any) -> Any:
            """The longest step, then its second-order correction where the violation rose, then shorter ones."""
            (before, at_before, _, _, violation_before), length, number = carry
            correct = (number == 1) & (violation_before >= violation)

            def corrected() -> Any:
                summed = jax.tree.map(lambda then, now: first * then + now, values, at_before)
                return change_at(at, slopes, curved, barrier, summed, first * gap + gaps(before, at_before), damping)

            other, other_step = jax.lax.cond(correct, corrected, lambda: (change, step))
            length = jnp.where(correct | (number == 0), length, length / 2)
            return judged(other, other_step, jnp.where(correct, longest_of(other_step), length)), length, number + 1

        def unfinished(carry: Any) -> Array:
            return ~carry[0][2] & (carry[1] > first * 2.0**-MOST_HALVINGS)

        untried = (at, values, jnp.asarray(False), jnp.asarray(False), violation), first, jnp.asarray(0)
        (new, at_new, good, descended, _), _, _ = jax.lax.while_loop(unfinished, attempt, untried)
        good &= change.convex
        new = new._replace(
            z=_guarded(new.z, new.s, barrier, present),
            y=new.y if elastic is None else _guarded(new.y, new.t, barrier, elastic),
        )
        # A step of the filter's second kind leaves a pair behind.
        keep = good & ~descended
        pair = jnp.stack([(1 - VIOLATION_MARGIN) * violation, phi - BARRIER_MARGIN * violation])
        filtered = jnp.where(keep, search.filter.at[entries % FILTER].set(pair), search.filter)
        raised = jnp.maximum(jnp.maximum(damping, search.damping) * 10, FIRST_DAMPING)
        short = jnp.where(good & (first > SHORT), 0, search.short + 1)
        release = (short >= MOST_SHORT) & ~done
        releases = search.releases + release
        lost = ~jnp.isfinite(largest(plain))
        conditions = [lost, done, releases > MOST_RELEASES, search.iterations + 1 >= iterations]
        outcomes = [Ending.NOT_FINITE, Ending.CONVERGED, Ending.NO_DESCENT, Ending.OUT_OF_ITERATIONS]
        ending = jnp.select(conditions, outcomes, Ending.UNDECIDED)
        at, values = jax.tree.map(
            lambda new, old: jnp.where(good & ~done, new, old), (new, at_new), (search.at, search.values)
        )
        used = jnp.where(damping > 0, damping, search.damping)
        after = Search(
            at, values, change.K, barrier, jnp.where(good, used, raised), jnp.where(good, 0.0, raised), filtered,
            entries + keep, search.largest, short, releases, search.iterations + ~done, plain, ending,
        )  # fmt: skip
        # The slacks as the whole step would leave them, negative where it is cut short.
        wanted = jnp.max(jnp.where(present, -(search.at.s + step.s), 0.0), initial=0.0)
        return jax.lax.cond(release, released, lambda after, _: after, after, wanted)

    def released(search: Search, width: Array) -> Search:
        """Widens the slacks, so that the inequalities are violated on the way, and starts anew."""
        at = search.at
        s = jnp.where(present, jnp.maximum(at.s, jnp.clip(width, 1e-1, 1e2)), at.s)
        z = jnp.where(present, FIRST_BARRIER / s, 0.0)
        y = at.y if elastic is None else jnp.where(elastic, FIRST_BARRIER / at.t, 0.0)
        at = at._replace(prices=0 * at.prices, nu=0 * at.nu, s=s, z=z, y=y)
        return _begun(search._replace(at=at))

    def _begun(search: Search) -> Search:
        barrier = jnp.full_like(search.barrier, FIRST_BARRIER)
        largest = LARGE_VIOLATION * jnp.maximum(measure(search.at, search.values, barrier)[0], 1.0)
        none = jnp.zeros_like(search.entries)
        zero = jnp.zeros_like(barrier)
        return search._replace(barrier=barrier, damping=zero, least=zero, entries=none, short=none, largest=largest)

    values = of.values(x, u)
    s = jnp.where(present, jnp.maximum(-values.c, 1e-2), 1.0)
    t = jnp.zeros_like(s)
    z = jnp.where(present, 1.0, 0.0)
    y = jnp.zeros_like(s)
    if elastic is not None:
        t = jnp.where(elastic, jnp.maximum(values.c, 0.0) + 1e-2, 0.0)
        s = jnp.where(elastic, jnp.maximum(t - values.c, 1e-2), s)
        y = jnp.where(elastic, linear + square * t - z, 0.0)
    at = Iterate(x, u, jnp.zeros_like(values.defects), jnp.zeros_like(values.h), s, z, t, y)
    barrier = jnp.asarray(FIRST_BARRIER, x.dtype)
    zero, none = jnp.zeros_like(barrier), jnp.asarray(0)
    start = Search(
        at, values, jnp.zeros((*u.shape, x.shape[1]), x.dtype), barrier, zero, zero, jnp.zeros((FILTER, 2), x.dtype),
        none, zero, none, none, none, Residuals(zero, zero, zero), jnp.asarray(Ending.UNDECIDED),
    )  # fmt: skip
    return jax.lax.while_loop(lambda search: search.ending == Ending.UNDECIDED, body, _begun(start))


def _tied(at: Iterate, elastic: Array | None, barrier: Any) -> Array:
    return jnp.zeros(0) if elastic is None else jnp.where(elastic, at.t * at.y - barrier, 0.0)


def _guarded(z: Array, s: Array, barrier: Array, mask: Array) -> Array:
    """Keeps s z within a factor of the barrier."""
    low, high = barrier / (MULTIPLIER_SPREAD * s), MULTIPLIER_SPREAD * barrier / s
    return jnp.where(mask, jnp.clip(z, low, high), 0.0)
