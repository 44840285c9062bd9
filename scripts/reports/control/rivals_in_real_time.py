"""Rivals of predictive control through CasADi: IPOPT and fatrop to their end, HPIPM in one iteration per sample.

All start from their solution at the sample before, shifted by a step. HPIPM's derivatives are generated C, compiled
with -O1; those of IPOPT and fatrop run in CasADi's virtual machine, since compilers take minutes for straight lines of
this length. Times are those of the solvers' calls.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from scripts.reports.control.plan_problems import Planned, Steps, runge_kutta
from scripts.reports.rival_modules import casadi

COMPILED = {"jit": True, "compiler": "shell", "jit_options": {"flags": "-O1 -march=native", "compiler": "gcc"}}
QUIET = {
    "ipopt": {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.warm_start_init_point": "yes", "ipopt.mu_init": 1e-3},
    "fatrop": {"fatrop.print_level": 0, "fatrop.mu_init": 1e-3, "structure_detection": "auto", "expand": True},
}


class Horizon(NamedTuple):
    """The problem as one program; unknowns are x_0, u_0, x_1, ..., x_N."""

    unknowns: Any
    cost: Any
    residuals: Any
    """Residuals; the sum of their squares is the cost."""
    gaps: Any
    lower: np.ndarray
    upper: np.ndarray
    lower_g: np.ndarray
    upper_g: np.ndarray


Controller = Callable[[np.ndarray], tuple[np.ndarray, float]]
"""Measured state -> control, and the CPU seconds of the call."""
Make = Callable[[np.ndarray], Controller]
"""Unknowns of a first solution -> controller."""


def horizon(problem: Planned, residuals: Callable[..., list[Any]]) -> Horizon:
    """Builds the program; `residuals` are (x, u) or (x, None) -> roots of the terms of the cost."""
    n, m, N = len(problem.x0), len(problem.limit), problem.steps
    assert isinstance(problem.step, Steps)
    step = runge_kutta(*problem.step)
    ca = casadi()
    X, U = [ca.SX.sym(f"x{k}", n) for k in range(N + 1)], [ca.SX.sym(f"u{k}", m) for k in range(N)]
    unknowns, roots, gaps, low, high = [], [], [], [], []
    for k in range(N + 1):
        unknowns.append(X[k])
        low += list(np.broadcast_to(problem.lower_x, n)) if k else [-np.inf] * n
        high += list(np.broadcast_to(problem.upper_x, n)) if k else [np.inf] * n
        if k < N:
            unknowns.append(U[k])
            low, high = [*low, *(-limit for limit in problem.limit)], [*high, *problem.limit]
            gaps.append(X[k + 1] - ca.vertcat(*step(ca, X[k], U[k])))
        roots += residuals(ca, X[k], U[k] if k < N else None)
    root = ca.vertcat(*roots)
    zero = np.zeros(n * N)
    return Horizon(
        ca.vertcat(*unknowns), ca.sumsqr(root), root, ca.vertcat(*gaps), np.array(low, float), np.array(high, float),
        zero, zero,
    )  # fmt: skip


def shifted(w: np.ndarray, n: int, m: int) -> np.ndarray:
    """Unknowns a step later, with the last control and state repeated."""
    return np.concatenate([w[n + m :], w[-m - n : -n], w[-n:]])


def to_the_end(name: str, problem: Planned, residuals: Callable[..., list[Any]]) -> Make:
    """Controllers by "ipopt" or "fatrop", warm-started."""
    n, m = len(problem.x0), len(problem.limit)
    of = horizon(problem, residuals)
    options = {"print_time": 0, **QUIET[name]}
    if name == "fatrop":
        options["equality"] = [True] * of.gaps.numel()
    ca = casadi()
    solver = ca.nlpsol("solver", name, {"x": of.unknowns, "f": of.cost, "g": of.gaps}, options)

    def act(memory: dict[str, Any], x: np.ndarray) -> tuple[np.ndarray, float]:
        lower, upper = of.lower.copy(), of.upper.copy()
        lower[:n] = upper[:n] = x
        guess = memory["x0"].copy()
        guess[:n] = x
        duals = {key: memory[key] for key in ("lam_x0", "lam_g0") if key in memory}
        began = time.process_time()
        result = solver(x0=guess, lbx=lower, ubx=upper, lbg=of.lower_g, ubg=of.upper_g, **duals)
        seconds = time.process_time() - began
        w = np.asarray(result["x"]).ravel()
        memory["x0"], u = shifted(w, n, m), w[n : n + m]
        memory["lam_x0"] = shifted(np.asarray(result["lam_x"]).ravel(), n, m)
        g = np.asarray(result["lam_g"]).ravel()
        memory["lam_g0"] = np.append(g[n:], g[-n:])
        return u, seconds

    return lambda first: partial(act, {"x0": first})


def hpipm(problem: Planned, residuals: Callable[..., list[Any]]) -> Make:
    """One Gauss-Newton step of sequential quadratic programming per sample, whose program HPIPM solves to its end."""
    n, m, N = len(problem.x0), len(problem.limit), problem.steps
    of = horizon(problem, residuals)
    ca = casadi()
    J = ca.jacobian(of.residuals, of.unknowns)
    H, gradient, A = 2 * J.T @ J, 2 * J.T @ of.residuals, ca.jacobian(of.gaps, of.unknowns)
    expand = ca.Function("expand", [of.unknowns], [H, gradient, A, of.gaps], COMPILED)
    options = {"N": N, "nx": [n] * (N + 1), "nu": [m] * N + [0], "ng": [0] * (N + 1), "print_time": 0}
    solver = ca.conic("solver", "hpipm", {"h": H.sparsity(), "a": A.sparsity()}, options)

    def act(memory: dict[str, np.ndarray], x: np.ndarray) -> tuple[np.ndarray, float]:
        w = memory["w"].copy()
        began = time.process_time()
        h, g, a, gaps = expand(w)
        lower, upper = of.lower - w, of.upper - w
        lower[:n] = upper[:n] = x - w[:n]
        result = solver(h=h, g=g, a=a, lba=-gaps, uba=-gaps, lbx=lower, ubx=upper)
        seconds = time.process_time() - began
        w += np.asarray(result["x"]).ravel()
        memory["w"] = shifted(w, n, m)
        return w[n : n + m], seconds

    return lambda first: partial(act, {"w": first})
