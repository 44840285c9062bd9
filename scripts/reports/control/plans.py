"""Plans with constraints beside IPOPT's: nine problems, twelve guesses each, the same transcription and guesses.

A plan counts as as low as IPOPT's if it converged and its cost exceeds that of IPOPT from the same guess by no more
than a millionth. Whether "converged" is true is checked apart: by derivatives of the whole Lagrangian at once, and by
the largest violation. Times are CPU times of calls after the first, in one process; compilation is reported apart.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import Shooting, TrajectoryProblem, integrated, shoot
from dln_jax.control.conditions import constraints
from dln_jax.solvers.ending import Ending
from scripts.reports.case import Findings
from scripts.reports.control.ipopt import ipopt
from scripts.reports.control.plan_problems import Planned, Steps, guesses, problems
from scripts.reports.rows import Row, expect

CLOSE = 1e-6
"""Largest relative excess of a cost over IPOPT's, and largest relative residual of a plan that converged."""
SHARE = 90 / 108
"""Share of plans to be as low as IPOPT's."""
FINE = 10
"""Substeps of the simulation between knots."""


class Compared(NamedTuple):
    """Results from one guess."""

    converged: bool
    as_low: bool
    lower: bool
    """Whether the cost is lower than IPOPT's by more than a millionth, or IPOPT did not converge."""
    wrong: bool
    infeasible: bool
    """Whether the plan claims that the problem is locally infeasible; all problems have solutions."""
    iterations: int
    ipopt_iterations: int
    seconds: float
    ipopt_seconds: float
    between: float
    """Largest violation of limits and constraints of states between the knots."""


def in_jax(problem: Planned) -> TrajectoryProblem:
    """The problem for `shoot`, with hard constraints as for IPOPT."""

    def stacked(formula: Callable[..., list[Any]] | None) -> Callable[..., Array] | None:
        return None if formula is None else lambda *arguments: jnp.stack(formula(jnp, *arguments))

    step = problem.step
    if isinstance(step, Steps):
        move = integrated(lambda x, u: jnp.stack(step.rates(jnp, x, u)), step.dt, substeps=step.substeps)
    else:
        move = lambda x, u: jnp.stack(step(jnp, x, u))  # noqa: E731
    limit = np.asarray(problem.limit)
    return TrajectoryProblem(
        move, lambda x, u: problem.cost(jnp, x, u), lambda x: problem.final_cost(jnp, x), -limit, limit,
        np.asarray(problem.lower_x), np.asarray(problem.upper_x), stacked(problem.path), stacked(problem.states),
        end=stacked(problem.end), soft=None, free=problem.free,
    )  # fmt: skip


def residual(problem: TrajectoryProblem, solution: Shooting) -> Array:
    """Largest residual of the conditions of an optimum, relative to the multipliers, from one Lagrangian of all."""
    x, u = solution.plan.x, solution.plan.u
    step_rows, end_rows, _ = constraints(problem, x.shape[1], u.shape[1])

    def rows(x: Array, u: Array) -> Array:
        return jnp.append(jax.vmap(step_rows)(x[:-1], u).ravel(), end_rows(x[-1]))

    def lagrangian(x: Array, u: Array) -> Array:
        cost = jnp.sum(jax.vmap(problem.cost)(x[:-1], u)) + problem.final_cost(x[-1])
        total = cost + jnp.sum(solution.multipliers * (jax.vmap(problem.step)(x[:-1], u) - x[1:]))
        total += solution.pressures @ rows(x, u)
        return total if problem.end is None else total + solution.end_multipliers @ problem.end(x[-1])

    by_x, by_u = jax.grad(lagrangian, argnums=(0, 1))(x, u)
    free = np.zeros(x.shape[1]) if problem.free is None else np.asarray(problem.free)
    every = jnp.concatenate([(by_x[0] * free)[None], by_x[1:]]).ravel(), by_u.ravel(), solution.pressures * rows(x, u)
    # As in the method, the cost counts by its scale.
    size = jnp.maximum(solution.scale, jnp.max(jnp.abs(solution.multipliers)))
    negative = jnp.maximum(-jnp.min(solution.pressures, initial=0.0), 0.0)
    return jnp.maximum(jnp.max(jnp.abs(jnp.concatenate(every))), negative) / size


def between_knots(problem: Planned, planned: TrajectoryProblem, solution: Shooting) -> Array:
    """Largest violation of limits and constraints of states in fine simulations from all knots; zero if none."""
    step = problem.step
    if not isinstance(step, Steps):
        return solution.violation
    move = integrated(lambda x, u: jnp.stack(step.rates(jnp, x, u)), step.dt / FINE)

    def excess(x: Array, u: Array) -> Array:
        def substep(x: Array, _: None) -> tuple[Array, Array]:
            new = move(x, u)
            return new, new

        after = jax.lax.scan(substep, x, length=FINE)[1]
        off = jnp.maximum(jnp.max(planned.lower_x - after), jnp.max(after - planned.upper_x))
        return off if planned.states is None else jnp.maximum(off, jnp.max(jax.vmap(planned.states)(after)))

    return jnp.maximum(0.0, jnp.max(jax.vmap(excess)(solution.plan.x[:-1], solution.plan.u)))


def compared(problem: Planned, count: int) -> tuple[list[Compared], float]:
    """Results from some guesses, and the CPU seconds of the compilation."""
    planned, rival = in_jax(problem), ipopt(problem)
    pairs = guesses(problem)[:count]
    began = time.process_time()
    solve = jax.jit(lambda states, u: shoot(planned, np.asarray(problem.x0), states, u)).lower(*pairs[0]).compile()
    compile_seconds = time.process_time() - began
    audit = jax.jit(partial(residual, planned))
    between = jax.jit(partial(between_knots, problem, planned))
    jax.block_until_ready(solve(*pairs[0]))
    results = []
    for pair in pairs:
        began = time.process_time()
        solution = jax.block_until_ready(solve(*pair))
        seconds, other = time.process_time() - began, rival(*pair)
        converged, cost = bool(solution.converged), float(solution.plan.cost)
        margin = CLOSE * max(1.0, abs(other.cost))
        as_low = converged and (not other.converged or cost <= other.cost + margin)
        off = max(float(solution.violation), float(solution.defect))
        wrong = converged and not (float(audit(solution)) <= CLOSE and off <= CLOSE)
        results.append(
            Compared(
                converged, as_low, as_low and (not other.converged or cost < other.cost - margin), wrong,
                int(solution.ending) == Ending.INFEASIBLE, int(solution.iterations), other.iterations, seconds,
                other.cpu_seconds, float(between(solution)),
            )
        )  # fmt: skip
    return results, compile_seconds


def plans(quick: bool) -> Findings:
    """Counts, iterations and times by problem, and the share of all plans that are as low as IPOPT's."""
    rows, every = [], []
    chosen = [problem for problem in problems() if not quick or problem.name in ("cart-pole", "shortest-time")]
    for problem in chosen:
        results, compile_seconds = compared(problem, 2 if quick else len(guesses(problem)))
        every += results
        case, words = f"plans/{problem.name}", f"of {len(results)} guesses"
        numbers = {name: np.array([result[i] for result in results]) for i, name in enumerate(Compared._fields)}
        for quantity in ("converged", "as_low", "lower"):
            rows.append(Row(case, f"{quantity}_share", float(np.mean(numbers[quantity])), expected=words))
        rows.append(Row(case, "iterations_median", float(np.median(numbers["iterations"]))))
        rows.append(Row(case, "ipopt_iterations_median", float(np.median(numbers["ipopt_iterations"]))))
        ours, rival = (1e3 * float(np.median(times)) for times in (numbers["seconds"], numbers["ipopt_seconds"]))
        rows.append(expect(case, "cpu_median_ms", "not above IPOPT's", ours, rival, "ms", reference=rival))
        rows.append(Row(case, "compile_cpu_seconds", compile_seconds, "s"))
        rows.append(Row(case, "between_knots_violation_worst", float(np.max(numbers["between"]))))
    words, as_low = f"of {len(every)} plans", float(np.mean([result.as_low for result in every]))
    rows.append(expect("plans/all", "as_low_share", words, as_low, SHARE, at_least=True))
    rows.append(Row("plans/all", "converged_share", float(np.mean([r.converged for r in every])), expected=words))
    rows.append(expect("plans/all", "wrongly_converged", words, sum(result.wrong for result in every), 0))
    rows.append(expect("plans/all", "wrongly_infeasible", words, sum(result.infeasible for result in every), 0))
    return Findings(rows)
