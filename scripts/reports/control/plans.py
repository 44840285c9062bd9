"""Plans with constraints beside IPOPT's: nine problems, twelve guesses each, the same transcription and guesses.

A plan counts as as low as IPOPT's if it converged and its cost exceeds that of IPOPT from the same guess by no more
than a millionth. Times are CPU times of calls after the first.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import Shooting, TrajectoryProblem, integrated, shoot
from dln_jax.control.conditions import constraints
from dln_jax.solvers.ending import Ending
from scripts.reports.control.problems import Planned, guesses, in_jax, problems
from scripts.reports.rivals.optimal_control import ipopt
from scripts.reports.run import Numbers

CLOSE = 1e-6
"""Largest relative excess of a cost over IPOPT's, and largest relative residual of a plan that converged."""
FINE = 10
"""Substeps of the simulation between knots."""


def residual(problem: TrajectoryProblem, solution: Shooting) -> Array:
    """Largest residual of the conditions of an optimum, relative to the multipliers, from one Lagrangian of all."""
    x, u = solution.plan.x, solution.plan.u
    step_rows, end_rows, _ = constraints(problem, x.shape[1], u.shape[1])

    def rows(x, u):
        return jnp.append(jax.vmap(step_rows)(x[:-1], u).ravel(), end_rows(x[-1]))

    def lagrangian(x, u):
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
    if problem.dt is None:
        return solution.violation
    move = integrated(lambda x, u: jnp.stack(problem.rates(jnp, x, u)), problem.dt / FINE)

    def excess(x, u):
        def fine(x, _):
            x = move(x, u)
            return x, x

        after = jax.lax.scan(fine, x, length=FINE)[1]
        off = jnp.maximum(jnp.max(planned.lower_x - after), jnp.max(after - planned.upper_x))
        return off if planned.states is None else jnp.maximum(off, jnp.max(jax.vmap(planned.states)(after)))

    return jnp.maximum(0.0, jnp.max(jax.vmap(excess)(solution.plan.x[:-1], solution.plan.u)))


def beside_ipopt(*, count: int = 12, names: tuple[str, ...] = tuple(one.name for one in problems())) -> Numbers:
    """Counts, iterations and times by problem, and the share of all plans that are as low as IPOPT's."""
    measured, every = {}, []
    for problem in (one for one in problems() if one.name in names):
        planned, rival, pairs, results = in_jax(problem), ipopt(problem), guesses(problem, count), []
        began = time.process_time()
        start = np.asarray(problem.x0)
        solve = jax.jit(lambda x, u: shoot(planned, start, x, u)).lower(*pairs[0]).compile()  # noqa: B023
        compile_seconds = time.process_time() - began
        audit = jax.jit(lambda one: (residual(planned, one), between_knots(problem, planned, one)))  # noqa: B023
        jax.block_until_ready(solve(*pairs[0]))
        for pair in pairs:
            began = time.process_time()
            solution = jax.block_until_ready(solve(*pair))
            seconds, other = time.process_time() - began, rival(*pair)
            converged, over = bool(solution.converged), float(solution.plan.cost) - other["cost"]
            margin = CLOSE * max(1.0, abs(other["cost"]))
            as_low = converged and (not other["converged"] or over <= margin)
            left, between = map(float, audit(solution))
            right = max(left, float(solution.violation), float(solution.defect)) <= CLOSE
            results.append(
                {
                    "converged": converged,
                    "as_low": as_low,
                    "lower": as_low and (not other["converged"] or over < -margin),
                    "wrong": converged and not right,
                    "infeasible": int(solution.ending) == Ending.INFEASIBLE,
                    "iterations": int(solution.iterations),
                    "ipopt_iterations": other["iterations"],
                    "seconds": seconds,
                    "ipopt_seconds": other["seconds"],
                    "between": between,
                }
            )
        every += results
        numbers = {key: np.array([one[key] for one in results]) for key in results[0]}
        ours, theirs = (1e3 * np.median(numbers[key]) for key in ("seconds", "ipopt_seconds"))
        measured[f"plans/{problem.name}"] = {
            **{f"{key}_share": np.mean(numbers[key]) for key in ("converged", "as_low", "lower")},
            **{f"{key}_median": np.median(numbers[key]) for key in ("iterations", "ipopt_iterations")},
            "cpu_median_ms": ours,
            "ipopt_cpu_median_ms": theirs,
            "cpu_over_ipopt": ours / theirs,
            "compile_cpu_seconds": compile_seconds,
            "between_knots_violation_worst": np.max(numbers["between"]),
        }
    totals = {key: [one[key] for one in every] for key in ("as_low", "converged", "wrong", "infeasible")}
    measured["plans/all"] = {
        "as_low_share": np.mean(totals["as_low"]),
        "converged_share": np.mean(totals["converged"]),
        "wrongly_converged": float(np.sum(totals["wrong"])),
        "wrongly_infeasible": float(np.sum(totals["infeasible"])),
    }
    return measured
