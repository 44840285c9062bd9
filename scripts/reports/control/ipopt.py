"""IPOPT through CasADi on the problems of `plan_problems`: the same unknowns, constraints and guesses."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scripts.reports.control.plan_problems import Planned, Steps, runge_kutta
from scripts.reports.rival_modules import casadi


class RivalPlan(NamedTuple):
    """Result of a run."""

    cost: float
    violation: float
    """Largest violation of a constraint."""
    converged: bool
    iterations: int
    cpu_seconds: float


def ipopt(problem: Planned) -> Callable[[np.ndarray, np.ndarray], RivalPlan]:
    """Returns (states, controls) -> plan, with exact derivatives and default settings."""
    ca = casadi()
    n, m, N = len(problem.x0), len(problem.limit), problem.steps
    X, U = ca.SX.sym("x", n, N + 1), ca.SX.sym("u", m, N)
    cost, g, low, high = ca.SX(0), [], [], []
    step = runge_kutta(*problem.step) if isinstance(problem.step, Steps) else problem.step
    for k in range(N):
        x, u = X[:, k], U[:, k]
        cost += problem.cost(ca, x, u)
        g.append(ca.vertcat(*step(ca, x, u)) - X[:, k + 1])
        low, high = [*low, *[0.0] * n], [*high, *[0.0] * n]
        if problem.path:
            rows = problem.path(ca, x, u)
            g, low, high = [*g, *rows], [*low, *[-np.inf] * len(rows)], [*high, *[0.0] * len(rows)]
        if problem.states:
            rows = problem.states(ca, X[:, k + 1])
            g, low, high = [*g, *rows], [*low, *[-np.inf] * len(rows)], [*high, *[0.0] * len(rows)]
    cost += problem.final_cost(ca, X[:, N])
    if problem.end:
        rows = problem.end(ca, X[:, N])
        g, low, high = [*g, *rows], [*low, *[0.0] * len(rows)], [*high, *[0.0] * len(rows)]
    lower = np.broadcast_to(np.asarray(problem.lower_x, float), (N + 1, n)).copy()
    upper = np.broadcast_to(np.asarray(problem.upper_x, float), (N + 1, n)).copy()
    fixed = np.logical_not(problem.free if problem.free is not None else [False] * n)
    lower[0, fixed] = upper[0, fixed] = np.asarray(problem.x0)[fixed]
    limit = np.tile(problem.limit, N)
    lbx, ubx = np.append(lower.ravel(), -limit), np.append(upper.ravel(), limit)
    unknowns = ca.vertcat(ca.vec(X), ca.vec(U))
    quiet = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 1000}
    solver = ca.nlpsol("plan", "ipopt", {"x": unknowns, "f": cost, "g": ca.vertcat(*g)}, quiet)

    def solve(states: np.ndarray, u: np.ndarray) -> RivalPlan:
        states = states.copy()
        states[0, fixed] = np.asarray(problem.x0)[fixed]
        began = time.process_time()
        solution = solver(x0=np.append(states.ravel(), u.ravel()), lbx=lbx, ubx=ubx, lbg=low, ubg=high)
        seconds, stats = time.process_time() - began, solver.stats()
        values = np.asarray(solution["g"]).ravel()
        violation = float(np.max(np.maximum(np.asarray(low) - values, values - np.asarray(high)), initial=0.0))
        return RivalPlan(float(solution["f"]), violation, bool(stats["success"]), int(stats["iter_count"]), seconds)

    return solve
