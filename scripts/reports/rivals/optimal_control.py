"""IPOPT, fatrop and HPIPM through CasADi, on the problems of `control.problems` with the same transcription.

HPIPM's derivatives are generated C, compiled with -O1; those of IPOPT and fatrop run in CasADi's virtual machine, since
compilers take minutes for straight lines of this length. Times are CPU times of the solvers' calls, in s.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from scripts.reports.control.problems import Formula, Planned
from scripts.reports.timing import casadi

Controller = Callable[[np.ndarray], tuple[np.ndarray, float]]
"""Measured state -> control, and the CPU seconds of the call."""
OPTIONS = {
    "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3},
    "fatrop": {"fatrop.print_level": 0, "fatrop.mu_init": 1e-3, "structure_detection": "auto", "expand": True},
}


def runge_kutta(rates: Formula, dt, substeps: int = 1) -> Callable[[Any, Any], Any]:
    """The step (x, u) -> x of the classical method in CasADi."""
    ca, h = casadi(), dt / substeps

    def step(x, u):
        for _ in range(substeps):
            k1 = ca.vertcat(*rates(ca, x, u))
            k2 = ca.vertcat(*rates(ca, x + h / 2 * k1, u))
            k3 = ca.vertcat(*rates(ca, x + h / 2 * k2, u))
            k4 = ca.vertcat(*rates(ca, x + h * k3, u))
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return step


def program(problem: Planned) -> tuple[dict[str, Any], dict[str, np.ndarray], Any]:
    """The problem with unknowns x_0, u_0, x_1, ..., x_N, its bounds, and the roots of its cost, if it states them."""
    ca, n, N = casadi(), len(problem.x0), problem.steps
    X = [ca.SX.sym(f"x{k}", n) for k in range(N + 1)]
    U = [ca.SX.sym(f"u{k}", len(problem.limit)) for k in range(N)]
    if problem.dt is None:
        step = lambda x, u: ca.vertcat(*problem.rates(ca, x, u))  # noqa: E731
    else:
        step = runge_kutta(problem.rates, problem.dt, problem.substeps)
    cost, roots, rows, least, low, high = problem.cost(ca, X[N], None), [], [], [], [], []
    for k in range(N + 1):
        bounds = np.broadcast_to(problem.lower_x, n), np.broadcast_to(problem.upper_x, n)
        free = np.zeros(n, bool) if problem.free is None else np.asarray(problem.free)
        held = ~free if k == 0 else np.zeros(n, bool)
        low, high = (
            [*measured, *np.where(held, problem.x0, bound)] for measured, bound in zip((low, high), bounds, strict=True)
        )
        more = [problem.states(ca, X[k])] if problem.states and k else []
        equal = [problem.end(ca, X[N])] if problem.end and k == N else []
        if k < N:
            low, high = [*low, *(-limit for limit in problem.limit)], [*high, *problem.limit]
            cost += problem.cost(ca, X[k], U[k])
            equal.append(ca.vertsplit(X[k + 1] - step(X[k], U[k])))
            more += [problem.path(ca, X[k], U[k])] if problem.path else []
        for group, bound in ((equal, 0.0), (more, -np.inf)):
            for row in (row for listed in group for row in listed):
                rows.append(row)
                least.append(bound)
        if problem.roots:
            roots += problem.roots(ca, X[k], U[k] if k < N else None)
    unknowns = ca.vertcat(*(part for pair in zip(X, U, strict=False) for part in pair), X[N])
    limits = {"lbx": np.array(low), "ubx": np.array(high), "lbg": np.array(least), "ubg": np.zeros(len(least))}
    return {"x": unknowns, "f": cost, "g": ca.vertcat(*rows)}, limits, ca.vertcat(*roots)


def unknowns_of(x: Any, u: Any) -> np.ndarray:
    """x_0, u_0, x_1, ..., x_N."""
    return np.append(np.concatenate([x[:-1], u], axis=1).ravel(), x[-1])


def ipopt(problem: Planned) -> Callable[[np.ndarray, np.ndarray], dict[str, float]]:
    """Returns (states, controls) -> cost, convergence, iterations and CPU seconds, with default settings."""
    nlp, limits, _ = program(problem)
    quiet = {"print_time": 0, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 1000}
    solver = casadi().nlpsol("plan", "ipopt", nlp, quiet)

    def solve(x, u):
        began = time.process_time()
        solution = solver(x0=unknowns_of(x, u), **limits)
        seconds, stats = time.process_time() - began, solver.stats()
        cost, iterations = float(solution["f"]), stats["iter_count"]
        return {"cost": cost, "converged": stats["success"], "iterations": iterations, "seconds": seconds}

    return solve


def to_the_end(name: str, problem: Planned, first: np.ndarray) -> Controller:
    """A controller by "ipopt" or "fatrop", which starts from its solution at the sample before, shifted by a step."""
    n, m = len(problem.x0), len(problem.limit)
    nlp, limits, _ = program(problem)
    equality = {"equality": [True] * len(limits["lbg"])} if name == "fatrop" else {}
    solver = casadi().nlpsol("solver", name, nlp, {"print_time": 0, **OPTIONS[name], **equality})
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


def hpipm(problem: Planned, first: np.ndarray) -> Controller:
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
