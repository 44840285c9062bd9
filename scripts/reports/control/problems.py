"""Problems of trajectory optimisation with constraints, as formulas for JAX and for CasADi alike, and first guesses.

All functions take the module of functions (`jax.numpy` or `casadi`) first, and states and controls that can be indexed,
so that a rival solves the same transcription: Runge-Kutta steps of fourth order, costs at the knots.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dln_jax.control.state_space import integrated
from dln_jax.control.trajectories import TrajectoryProblem
from dln_jax.scenes.pendulums import Links
from scripts.reports.timing import casadi

GRAVITY = 9.81
Formula = Callable[..., Any]
"""(functions, x, u) -> list or vector."""
Cost = Callable[..., Any]
"""(functions, x, u), or (functions, x, None) at the end -> number."""


class Planned(NamedTuple):
    """A problem; constraints are not above zero, equations of the end are zero."""

    name: str
    x0: Any
    goal: Any
    steps: int
    rates: Formula
    """Rates of the state, or its next value if `dt` is `None`."""
    dt: float | None
    substeps: int
    cost: Cost
    limit: Sequence[float]
    """Limits of the controls, of both signs."""
    lower_x: Any = -np.inf
    upper_x: Any = np.inf
    states: Callable[..., Any] | None = None
    end: Callable[..., Any] | None = None
    free: Any = None
    """Mask of the first state's components that are unknowns."""
    spread: float = 0.3
    """Size of the guesses' random parts, relative to the way to the goal and to the limits."""
    roots: Formula | None = None
    """Roots of the cost's terms."""


class Sizes(NamedTuple):
    """A cart-pole: kg, kg, m, kg m² about the pole's centre, N s/m, N m s."""

    cart: float = 0.57
    pole: float = 0.127
    length: float = 0.16825
    """Distance of the pole's centre from its hinge."""
    inertia: float = 0.0
    damping: tuple[float, float] = (0.1, 1e-3)


def in_jax(problem: Planned) -> TrajectoryProblem:
    """The problem for `shoot`, with hard constraints."""

    def stacked(formula):
        return None if formula is None else lambda *arguments: jnp.stack(formula(jnp, *arguments))

    def step(x, u):
        return jnp.stack(problem.rates(jnp, x, u))

    limit = np.asarray(problem.limit)
    return TrajectoryProblem(
        step if problem.dt is None else integrated(step, problem.dt, substeps=problem.substeps),
        lambda x, u: problem.cost(jnp, x, u),
        lambda x: problem.cost(jnp, x, None),
        -limit,
        limit,
        np.asarray(problem.lower_x),
        np.asarray(problem.upper_x),
        states=stacked(problem.states),
        end=stacked(problem.end),
        soft=None,
        free=problem.free,
    )


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
    ca, n, N, limit = casadi(), len(problem.x0), problem.steps, np.asarray(problem.limit)
    X = [ca.SX.sym(f"x{k}", n) for k in range(N + 1)]
    U = [ca.SX.sym(f"u{k}", len(limit)) for k in range(N)]
    if problem.dt is None:
        step = lambda x, u: ca.vertcat(*problem.rates(ca, x, u))  # noqa: E731
    else:
        step = runge_kutta(problem.rates, problem.dt, problem.substeps)
    cost, roots, rows, least = 0.0, [], [], []
    for k, (x, u) in enumerate(zip(X, [*U, None], strict=True)):
        cost += problem.cost(ca, x, u)
        roots += problem.roots(ca, x, u) if problem.roots else []
        equal = problem.end(ca, x) if u is None and problem.end else []
        if u is not None:
            equal = ca.vertsplit(X[k + 1] - step(x, u))
        below = problem.states(ca, x) if problem.states and k else []
        rows += [*equal, *below]
        least += [0.0] * len(equal) + [-np.inf] * len(below)
    lower, upper = np.broadcast_to(problem.lower_x, n), np.broadcast_to(problem.upper_x, n)
    free = np.zeros(n, bool) if problem.free is None else problem.free
    limits = {
        "lbx": np.concatenate([np.where(free, lower, problem.x0), *[-limit, lower] * N]),
        "ubx": np.concatenate([np.where(free, upper, problem.x0), *[limit, upper] * N]),
        "lbg": np.array(least),
        "ubg": np.zeros(len(least)),
    }
    unknowns = ca.vertcat(*(part for pair in zip(X, U, strict=False) for part in pair), X[N])
    return {"x": unknowns, "f": cost, "g": ca.vertcat(*rows)}, limits, ca.vertcat(*roots)


def cart_pole_rates(sizes: Sizes) -> Formula:
    """Rates of position, angle from upright, and their rates."""
    cart, pole, length, inertia, damping = sizes

    def rates(f, x, u):
        s, c = f.sin(x[1]), f.cos(x[1])
        force = u[0] - damping[0] * x[2] + pole * length * s * x[3] ** 2
        torque = pole * GRAVITY * length * s - damping[1] * x[3]
        a, b, d = cart + pole, pole * length * c, pole * length**2 + inertia
        det = a * d - b * b
        return [x[2], x[3], (d * force - b * torque) / det, (a * torque - b * force) / det]

    return rates


def two_links(motors: tuple[int, ...], gravity: float = GRAVITY) -> Formula:
    """The board's double pendulum (design C.1), hanging at zero, with motors at some joints."""
    (m1, m2), (l1, _), (r1, r2), (i1, i2) = Links()

    def rates(f, x, u):
        tau = [0.0, 0.0]
        for index, joint in enumerate(motors):
            tau[joint] = u[index]
        c2, s2 = f.cos(x[1]), f.sin(x[1])
        k = m2 * l1 * r2
        a, b, d = i1 + i2 + m2 * l1**2 + 2 * k * c2, i2 + k * c2, i2
        far = gravity * m2 * r2 * f.sin(x[0] + x[1])
        p = tau[0] - gravity * (m1 * r1 + m2 * l1) * f.sin(x[0]) - far + k * s2 * (2 * x[2] * x[3] + x[3] ** 2)
        q = tau[1] - far - k * s2 * x[2] ** 2
        det = a * d - b * b
        return [x[2], x[3], (d * p - b * q) / det, (a * q - b * p) / det]

    return rates


def flexible_rates(f, x, u) -> list[Any]:
    """A driven cart, a spring of 200 N/m, a carried cart with a pole; states cart, spring, pole and rates."""
    ma, mb, mp, length = 0.57, 0.375, 0.127, 0.1778
    s, c, pull = f.sin(x[2]), f.cos(x[2]), 200.0 * x[1]
    a = (u[0] + pull - 0.5 * x[3]) / ma
    force = -pull - 0.5 * (x[3] + x[4]) + mp * length * s * x[5] ** 2
    # (mb + mp) e + mp l c w' = force,  mp l² w' + mp l c e = mp g l s - d w
    drive = GRAVITY * s - 0.0024 * x[5] / (mp * length)
    e = (force - mp * c * drive) / (mb + mp * s**2)
    return [x[3], x[4], x[5], a, e - a, (drive - c * e) / length]


def rotor_rates(f, x, u) -> list[Any]:
    """A quadrotor in the plane: 0.5 kg, 0.01 kg m², arms of 0.2 m; controls are the deviations of both thrusts."""
    lift = (u[0] + u[1]) / 0.5 + GRAVITY
    return [x[3], x[4], x[5], -lift * f.sin(x[2]), lift * f.cos(x[2]) - GRAVITY, 0.2 * (u[1] - u[0]) / 0.01]


def squares(
    goal: Sequence[float], weights: Sequence[float], force: float, dt: float, last: float, angle: int | None = None
) -> Cost:
    """Squared errors of states and controls, with 2 (1 - cos) of one angle."""

    def cost(f, x, u):
        off = 0.0
        for i, weight in enumerate(weights):
            off = off + weight * (2 * (1 - f.cos(x[i])) if i == angle else (x[i] - goal[i]) ** 2)
        return last * off if u is None else dt * (off + force * sum(u[i] ** 2 for i in range(u.shape[0])))

    return cost


def problems() -> list[Planned]:
    """The eight."""
    pi, zero = math.pi, (0.0,) * 6
    up, hanging = (pi, 0.0, 0.0, 0.0), (0.0, pi, 0.0, 0.0)
    links, there, rail = (1.0, 1.0, 0.1, 0.1), (1.5, 1.0, 0.0, 0.0), np.array([0.5, *(np.inf,) * 3])
    cart = cart_pole_rates(Sizes(1.0, 0.1, 0.5, 0.0, (0.0, 0.0)))
    return [
        Planned("cart-pole", hanging, zero[:4], 50, cart, 0.04, 1, squares(zero, links, 0.01, 0.04, 50.0, 1), (10.0,),
                -rail, rail),
        Planned("acrobot", zero[:4], up, 60, two_links((1,)), 0.04, 2, squares(up, links, 0.1, 0.04, 100.0), (6.0,)),
        Planned("pendubot", zero[:4], up, 50, two_links((0,)), 0.03, 2, squares(up, links, 0.1, 0.03, 100.0), (6.0,)),
        Planned("two-link-reach", (-0.5, 2.0, 0.0, 0.0), there, 50, two_links((0, 1), 0.0), 0.02, 1,
                squares(there, links, 0.1, 0.02, 50.0), (2.0, 2.0)),
        Planned("flexible-cart-pole", (0.0, 0.0, pi, 0.0, 0.0, 0.0), zero, 50, flexible_rates, 0.04, 2,
                squares(zero, (1.0, 0.0, 1.0, 0.02, 0.0, 0.001), 1e-3, 0.04, 50.0, 2), (15.0,)),
        Planned("quadrotor-wall", (-2.0, *zero[1:]), (2.0, *zero[1:]), 50, rotor_rates, 0.05, 1,
                squares((2.0, *zero[1:]), (1.0, 1.0, 0.1, 0.1, 0.1, 0.01), 0.1, 0.05, 50.0), (2.0, 2.0),
                states=lambda f, x: [1.0 - (x[0] / 0.3) ** 2 - (x[1] + 0.4) ** 2]),
        # A double integrator, exactly, whose third state is the duration of the step.
        Planned("shortest-time", (0.0, 0.0, 0.05), (1.0, 0.0, 0.05), 40,
                lambda f, x, u: [x[0] + x[2] * x[1] + x[2] ** 2 / 2 * u[0], x[1] + x[2] * u[0], x[2]], None, 1,
                lambda f, x, u: 0.0 * x[0] if u is None else x[2], (1.0,), (-np.inf, -np.inf, 1e-3),
                (np.inf, np.inf, 1.0), end=lambda f, x: [x[0] - 1.0, x[1]], free=(False, False, True)),
        # A rod of 1 kg and 1 m.
        Planned("hanging-start", (pi, 0.0), (pi, 0.0), 60,
                lambda f, x, u: [x[1], 3 * (u[0] + GRAVITY / 2 * f.sin(x[0]))], 0.05, 1,
                squares(zero, (1.0, 0.05), 0.05, 0.05, 20.0, 0), (2.5,), spread=0.01),
    ]  # fmt: skip


def guesses(problem: Planned, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """States [N+1, n] and controls [N, m]: a straight line at rest, then lines with smooth random parts."""
    random, N = np.random.default_rng(0), problem.steps
    x0, goal, limit = (np.asarray(a, float) for a in (problem.x0, problem.goal, problem.limit))
    line, way = np.linspace(x0, goal, N + 1), np.maximum(np.abs(goal - x0), 0.3)
    pairs = [(line, np.zeros((N, len(limit))))]
    waves = np.sin(np.pi * np.arange(1, 6) * np.linspace(0, 1, N + 1)[:, None])
    while len(pairs) < count:
        part_x = waves @ (random.normal(size=(5, len(x0))) / np.arange(1, 6)[:, None])
        part_u = waves[:-1] @ random.normal(size=(5, len(limit)))
        pairs.append((line + problem.spread * way * part_x, problem.spread * limit * part_u))
    return pairs
