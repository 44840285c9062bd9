"""Plans and predictive control with constraints beside IPOPT, fatrop and HPIPM, on the same transcriptions.

Plans are of eight problems from twelve guesses each. One counts as as low as IPOPT's if it converged and its cost
exceeds that of IPOPT from the same guess by no more than a millionth.

Predictive control is that of a cart-pole between walls: the plant of Lutter et al. 2021 (arXiv 2105.04682), 12 N, rail
of +-0.5 m, 100 Hz, a horizon of 1.2 s in 120 steps. All controllers start with the plan of `shoot` from the start at
rest. HPIPM's derivatives are generated C, compiled with -O1; those of IPOPT and fatrop run in CasADi's virtual machine,
since compilers take minutes for straight lines of this length. Times are CPU times of calls after the first.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.constraints import rows_of, stacked
from dln_jax.control.real_time import feedback, improve, prepare
from dln_jax.control.shooting import Shooting, shoot
from dln_jax.control.state_space import integrated
from dln_jax.control.trajectories import Plan, TrajectoryProblem, first_plan
from dln_jax.export.c.interface import Cost, stated_costs
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.solvers.ending import Ending
from scripts.reports.control.problems import Planned, Sizes, cart_pole_rates, guesses, in_jax, problems, program
from scripts.reports.run import Numbers
from scripts.reports.timing import casadi

CLOSE = 1e-6
"""Largest relative excess of a cost over IPOPT's, and largest relative residual of a plan that converged."""
FINE = 10
"""Substeps of the simulation between knots."""
DT, STEPS, LIMIT, RAIL = 0.01, 120, 12.0, 0.5
"""Sample, s, steps of the horizon, force limit, N, and half the rail, m."""
BARRIER, HANGING = 1e-4, np.array([0.0, np.pi, 0.0, 0.0])
Acting = Callable[..., tuple[np.ndarray, float]]
"""Measured state, and the knots if the problem has some -> control, and the CPU seconds of the call."""
QUIET = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes"}
OPTIONS = {
    "ipopt": QUIET | {"ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3},
    "fatrop": {
        "print_time": 0,
        "fatrop.print_level": 0,
        "fatrop.mu_init": 1e-3,
        "structure_detection": "auto",
        "expand": True,
    },
}


def residual(problem: TrajectoryProblem, solution: Shooting) -> Array:
    """Largest residual of the conditions of an optimum, relative to the multipliers, from one Lagrangian of all."""
    x, u = solution.plan.x, solution.plan.u
    of_steps, of_end = rows_of(problem, x.shape[1], u.shape[1])
    step_rows, end_rows = stacked(of_steps), stacked([one for one in of_end if one.kind != "equation"])

    def rows(x, u):
        return jnp.append(jax.vmap(step_rows)(x[:-1], u).ravel(), end_rows(x[-1], None))

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


def unknowns_of(x, u) -> np.ndarray:
    """x_0, u_0, x_1, ..., x_N."""
    return np.append(np.concatenate([x[:-1], u], axis=1).ravel(), x[-1])


def ipopt(problem: Planned) -> Callable[[np.ndarray, np.ndarray], tuple[float, bool, int, float]]:
    """Returns (states, controls) -> cost, convergence, iterations and CPU seconds, with default settings."""
    nlp, limits, _ = program(problem)
    solver = casadi().nlpsol("plan", "ipopt", nlp, QUIET | {"ipopt.max_iter": 1000})

    def solve(x, u):
        began = time.process_time()
        solution = solver(x0=unknowns_of(x, u), **limits)
        seconds, stats = time.process_time() - began, solver.stats()
        return float(solution["f"]), stats["success"], stats["iter_count"], seconds

    return solve


def beside_ipopt(*, count: int = 12, names: tuple[str, ...] = tuple(one.name for one in problems())) -> Numbers:
    """Counts, iterations and times by problem, and the share of all plans that are as low as IPOPT's."""
    measured, totals = {}, []
    for problem in (one for one in problems() if one.name in names):
        planned, rival, pairs, rows = in_jax(problem), ipopt(problem), guesses(problem, count), []
        solve = jax.jit(partial(shoot, planned, np.asarray(problem.x0)))
        audit = jax.jit(lambda one, p=problem, q=planned: (residual(q, one), between_knots(p, q, one)))
        jax.block_until_ready(solve(*pairs[0]))
        for pair in pairs:
            began = time.process_time()
            solution = jax.block_until_ready(solve(*pair))
            seconds = time.process_time() - began
            cost, rival_converged, rival_iterations, rival_seconds = rival(*pair)
            left, between = map(float, audit(solution))
            converged, over = bool(solution.converged), float(solution.plan.cost) - cost
            margin = CLOSE * max(1.0, abs(cost))
            as_low = converged and (not rival_converged or over <= margin)
            lower = as_low and (not rival_converged or over < -margin)
            wrong = converged and max(left, float(solution.violation), float(solution.defect)) > CLOSE
            infeasible = int(solution.ending) == Ending.INFEASIBLE
            totals.append((as_low, converged, wrong, infeasible))
            rows.append((as_low, lower, int(solution.iterations), rival_iterations, seconds, rival_seconds, between))
        as_low, lower, *medians, between = np.array(rows, float).T
        iterations, rival_iterations, seconds, rival_seconds = np.median(medians, axis=1)
        measured[f"plans/{problem.name}"] = {
            "as_low_share": np.mean(as_low),
            "lower_share": np.mean(lower),
            "iterations_median": iterations,
            "ipopt_iterations_median": rival_iterations,
            "cpu_median_ms": 1e3 * seconds,
            "ipopt_cpu_median_ms": 1e3 * rival_seconds,
            "cpu_over_ipopt": seconds / rival_seconds,
            "between_knots_violation_worst": np.max(between),
        }
    as_low, converged, wrong, infeasible = np.array(totals, float).T
    shares = {"as_low_share": np.mean(as_low), "converged_share": np.mean(converged)}
    measured["plans/all"] = {**shares, "wrongly_converged": wrong.sum(), "wrongly_infeasible": infeasible.sum()}
    return measured


def roots(f, x, u) -> list[Any]:
    """Roots of the cost's terms; 2 (1 - cos) = 4 sin² of half the angle."""
    weight = np.sqrt(20.0 if u is None else DT)
    terms = [2.0 * x[0], 2 * f.sin(x[1] / 2), np.sqrt(0.1) * x[2], np.sqrt(0.01) * x[3]]
    return [weight * term for term in (terms if u is None else [*terms, np.sqrt(1e-3) * u[0]])]


def cart_pole(sizes: Sizes = Sizes(), *, margin: float = 0.02) -> Planned:  # noqa: B008
    """The problem; plans keep a margin from the ends of the rail, m."""
    wall, cost = np.array([RAIL - margin, *[np.inf] * 3]), lambda f, x, u: sum(root**2 for root in roots(f, x, u))
    rates, goal = cart_pole_rates(sizes), (0.0,) * 4
    return Planned("cart-pole", tuple(HANGING), goal, STEPS, rates, DT, 1, cost, (LIMIT,), -wall, wall, roots=roots)


def starting(problem: TrajectoryProblem) -> Callable[[Any], Plan]:
    """Returns start -> plan of `shoot` from straight lines to both sides."""
    line, other = (np.linspace(HANGING, [0, angle, 0, 0], STEPS + 1) for angle in (0.0, 2 * np.pi))
    still = np.zeros((STEPS, 1))
    return jax.jit(lambda x: shoot(problem, x, line, still, starts=(other[None], still[None])).plan)


def in_c(problem: TrajectoryProblem, plan: Plan, **settings) -> tuple[Callable[[Plan], Acting], Mapping[str, Cost]]:
    """Returns plan -> controller of `feedback` and `prepare` as compiled C, and the costs of their calls.

    Its memory is the plan. Settings are those of `prepare`.
    """

    def respond(x, u, states, gains):
        return feedback(problem, plan._replace(u=u, x=states, K=gains), x)

    def renew(x, u, states, gains, damping, *knots):
        now = problem._replace(knots=knots[0]) if knots else problem
        after = prepare(now, plan._replace(u=u, x=states, K=gains, damping=damping), x, **settings)
        return {"controls": after.u, "next": after.x, "feedback": after.K, "size": after.damping}

    knots = () if problem.knots is None else (problem.knots,)
    examples = tuple(map(np.asarray, (plan.x[0], plan.u, plan.x, plan.K, plan.damping, *knots)))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "plan"
        export_c({"respond": (respond, examples[:4]), "renew": (renew, examples)}, folder, stack=2**21)
        functions, costs = load_c(folder), stated_costs(folder)

    def controller(plan):
        memory = [np.asarray(array) for array in (plan.u, plan.x, plan.K, plan.damping)]

        def act(x, *knots):
            began = time.thread_time_ns()
            u = functions.respond(x, *memory[:3])
            after = functions.renew(x, *memory[:3], float(memory[3]), *knots)
            seconds = (time.thread_time_ns() - began) / 1e9
            memory[:] = after.controls, after.next, after.feedback, after.size
            return np.atleast_1d(u), seconds

        return act

    return controller, costs


def settling(problem: TrajectoryProblem, barrier: float) -> Callable[[Plan], Plan]:
    """Returns plan -> plan after ten iterations."""
    return jax.jit(lambda plan: jax.lax.fori_loop(0, 10, lambda _, plan: improve(problem, plan, barrier=barrier), plan))


def quantiles_ms(seconds) -> dict[str, float]:
    """Median, 99th percentile and worst of some times."""
    values = 1e3 * np.percentile(np.ravel(seconds), [50, 99, 100])
    return dict(zip(("p50_ms", "p99_ms", "worst_ms"), values, strict=True))


def to_the_end(name: str, problem: Planned, first: np.ndarray) -> Acting:
    """A controller by "ipopt" or "fatrop", which starts from its solution at the sample before, shifted by a step."""
    n, m = len(problem.x0), len(problem.limit)
    nlp, limits, _ = program(problem)
    equality = {"equality": [True] * len(limits["lbg"])} if name == "fatrop" else {}
    solver = casadi().nlpsol("solver", name, nlp, OPTIONS[name] | equality)
    guess: dict[str, np.ndarray] = {"x0": first}

    def act(x):
        guess["x0"][:n] = limits["lbx"][:n] = limits["ubx"][:n] = x
        began = time.process_time()
        result = solver(**guess, **limits)
        seconds = time.process_time() - began
        w, duals, g = (np.asarray(result[key]).ravel() for key in ("x", "lam_x", "lam_g"))
        guess.update(x0=shifted(w, n, m), lam_x0=shifted(duals, n, m), lam_g0=np.append(g[n:], g[-n:]))
        return w[n : n + m], seconds

    return act


def hpipm(problem: Planned, first: np.ndarray) -> Acting:
    """One Gauss-Newton step of sequential quadratic programming per sample, whose program HPIPM solves to its end."""
    ca, n, m, N = casadi(), len(problem.x0), len(problem.limit), problem.steps
    nlp, limits, roots = program(problem)
    J = ca.jacobian(roots, nlp["x"])
    H, gradient, A = 2 * J.T @ J, 2 * J.T @ roots, ca.jacobian(nlp["g"], nlp["x"])
    compiled = {"jit": True, "compiler": "shell", "jit_options": {"flags": "-O1 -march=native", "compiler": "gcc"}}
    expand = ca.Function("expand", [nlp["x"]], [H, gradient, A, nlp["g"]], compiled)
    sizes = {"N": N, "nx": [n] * (N + 1), "nu": [m] * N + [0], "ng": [0] * (N + 1), "print_time": 0}
    solver = ca.conic("solver", "hpipm", {"h": H.sparsity(), "a": A.sparsity()}, sizes)
    memory = {"w": first}

    def act(x):
        w = memory["w"]
        began = time.process_time()
        h, g, a, gaps = expand(w)
        lower, upper = limits["lbx"] - w, limits["ubx"] - w
        lower[:n] = upper[:n] = x - w[:n]
        result = solver(h=h, g=g, a=a, lba=-gaps, uba=-gaps, lbx=lower, ubx=upper)
        seconds = time.process_time() - began
        w = w + np.asarray(result["x"]).ravel()
        memory["w"] = shifted(w, n, m)
        return w[n : n + m], seconds

    return act


def shifted(w: np.ndarray, n: int, m: int) -> np.ndarray:
    """Unknowns a step later, with the last control and state repeated."""
    return np.concatenate([w[n + m :], w[-m - n : -n], w[-n:]])


def beside_rivals(*, loops: int = 10, rival_loops: int = 2) -> Numbers:
    """Times, closed-loop costs and largest positions of all controllers, in 2.5 s of a finer simulation."""
    planned = cart_pole()
    problem = in_jax(planned)
    solve, settle = starting(problem), settling(problem, BARRIER)
    finer = jax.jit(integrated(lambda x, u: jnp.stack(planned.rates(jnp, x, u)), DT, substeps=4))
    ours, costs = in_c(problem, first_plan(problem, HANGING, np.zeros((STEPS, 1))), barrier=BARRIER)
    controllers: dict[str, Callable[[Plan], Acting]] = {
        "c": lambda plan: ours(settle(plan)),
        "ipopt": lambda plan: to_the_end("ipopt", planned, unknowns_of(plan.x, plan.u)),
        "fatrop": lambda plan: to_the_end("fatrop", planned, unknowns_of(plan.x, plan.u)),
        "hpipm": lambda plan: hpipm(planned, unknowns_of(plan.x, plan.u)),
    }
    # As in the published evaluation.
    drawn = np.random.default_rng(0).normal(size=(loops, 4)) * np.sqrt([1e-3, 5e-2, 1e-6, 1e-6]) + HANGING
    measured: dict[str, dict[str, float]] = {}
    for name, make in controllers.items():
        states, paid, times = [], [], []
        for x in drawn if name == "c" else drawn[:rival_loops]:
            act, run, cost = make(solve(x)), [x], 0.0
            for _ in range(250):
                u, seconds = act(x)
                cost += float(planned.cost(np, x, u))
                x = np.asarray(finer(x, u))
                run.append(x)
                times.append(seconds)
            states.append(run)
            paid.append(cost)
        x = np.array(states)
        measured[f"realtime/cart-pole/{name}"] = {
            **quantiles_ms(times),
            "up_share": np.mean(np.all(np.cos(x[:, -20:, 1]) > np.cos(0.1), axis=1)),
            "first_starts_cost_mean": np.mean(paid[:rival_loops]),
            "largest_position": np.abs(x[..., 0]).max(),
        }
    for name, cost in costs.items():
        measured[f"realtime/cart-pole/c-{name}"] = {"operations": cost.operations, "stack_bytes": cost.stack_bytes}
    return measured
