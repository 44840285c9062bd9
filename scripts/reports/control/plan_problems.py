"""Nine problems of trajectory optimisation with constraints, as formulas for JAX and for CasADi alike, and guesses.

All functions take the module of functions (`jax.numpy` or `casadi`) first, and states and controls that can be indexed;
they return lists. So the rival solves the same transcription: Runge-Kutta steps of fourth order, costs at the knots.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from scripts.reports.control.plan_arm import accelerated, beyond_torques, clear_of_sphere, tip_error

GRAVITY = 9.81
GUESSES = 12
Formula = Callable[..., list[Any]]
"""(functions, x, u) -> list."""


class Planned(NamedTuple):
    """A problem; constraints [p] are not above zero, equations of the end are zero."""

    name: str
    x0: Sequence[float]
    goal: Sequence[float]
    steps: int
    step: "Formula | Steps"
    cost: Callable[..., Any]
    """(functions, x, u) -> cost of a step."""
    final_cost: Callable[..., Any]
    limit: Sequence[float]
    """Limits of the controls, of both signs."""
    lower_x: Any = -np.inf
    upper_x: Any = np.inf
    path: Formula | None = None
    states: Callable[..., list[Any]] | None = None
    end: Callable[..., list[Any]] | None = None
    free: Any = None
    """Mask of the first state's components that are unknowns."""
    spread: float = 0.3
    """Size of the guesses' random parts, relative to the way to the goal and to the limits."""


class Steps(NamedTuple):
    """Rates of a plant, integrated by the classical Runge-Kutta method."""

    rates: Formula
    dt: float
    substeps: int = 1


def runge_kutta(rates: Formula, dt: Any, substeps: int = 1) -> Formula:
    """The step of the classical method for CasADi."""

    def step(f: Any, x: Any, u: Any) -> list[Any]:
        x, h = [x[i] for i in rates_size(x)], dt / substeps
        for _ in range(substeps):
            k1 = rates(f, x, u)
            k2 = rates(f, [a + h / 2 * b for a, b in zip(x, k1, strict=True)], u)
            k3 = rates(f, [a + h / 2 * b for a, b in zip(x, k2, strict=True)], u)
            k4 = rates(f, [a + h * b for a, b in zip(x, k3, strict=True)], u)
            x = [a + h / 6 * (p + 2 * q + 2 * r + s) for a, p, q, r, s in zip(x, k1, k2, k3, k4, strict=True)]
        return x

    return step


def rates_size(x: Any) -> range:
    """Indices of a state: of a list, an array or a CasADi column."""
    return range(x.shape[0] if hasattr(x, "shape") else len(x))


def pole_rates(f: Any, x: Any, u: Any) -> list[Any]:
    """Cart of 1 kg and pole of 0.1 kg, 0.5 m; upright at zero."""
    cart, pole, length = 1.0, 0.1, 0.5
    s, c = f.sin(x[1]), f.cos(x[1])
    # (cart + pole) a + pole l c b = u + pole l s w²,  l b + c a = g s
    a = (u[0] + pole * length * s * x[3] ** 2 - pole * GRAVITY * s * c) / (cart + pole * s**2)
    return [x[2], x[3], a, (GRAVITY * s - c * a) / length]


def two_links(motors: tuple[int, ...], gravity: float = GRAVITY) -> Formula:
    """The board's double pendulum (design C.1), hanging at zero, with motors at some joints."""
    m1, m2, l1, r1, r2 = 0.5234602302310271, 0.6255677234174437, 0.2, 0.2, 0.25569305436052964
    i1, i2 = 0.031887199591513114, 0.05086984812807257

    def rates(f: Any, x: Any, u: Any) -> list[Any]:
        tau = [0.0, 0.0]
        for index, joint in enumerate(motors):
            tau[joint] = u[index]
        c2, s2 = f.cos(x[1]), f.sin(x[1])
        k = m2 * l1 * r2
        a, b, d = i1 + i2 + m2 * l1**2 + 2 * k * c2, i2 + k * c2, i2
        g1 = gravity * (m1 * r1 * f.sin(x[0]) + m2 * (l1 * f.sin(x[0]) + r2 * f.sin(x[0] + x[1])))
        g2 = gravity * m2 * r2 * f.sin(x[0] + x[1])
        p = tau[0] - g1 + k * s2 * (2 * x[2] * x[3] + x[3] ** 2)
        q = tau[1] - g2 - k * s2 * x[2] ** 2
        det = a * d - b * b
        return [x[2], x[3], (d * p - b * q) / det, (a * q - b * p) / det]

    return rates


def flexible_rates(f: Any, x: Any, u: Any) -> list[Any]:
    """A driven cart, a spring of 200 N/m, a carried cart with a pole; states cart, spring, pole and rates."""
    ma, mb, mp, length, k = 0.57, 0.375, 0.127, 0.1778, 200.0
    s, c = f.sin(x[2]), f.cos(x[2])
    pull = k * x[1]
    a = (u[0] + pull - 0.5 * x[3]) / ma
    force = -pull - 0.5 * (x[3] + x[4]) + mp * length * s * x[5] ** 2
    # (mb + mp) e + mp l c w' = force,  mp l² w' + mp l c e = mp g l s - d w
    drive = GRAVITY * s - 0.0024 * x[5] / (mp * length)
    e = (force - mp * c * drive) / (mb + mp * s**2)
    return [x[3], x[4], x[5], a, e - a, (drive - c * e) / length]


def rotor_rates(f: Any, x: Any, u: Any) -> list[Any]:
    """A quadrotor in the plane: 0.5 kg, 0.01 kg m², arms of 0.2 m; controls are the deviations of both thrusts."""
    mass, inertia, arm = 0.5, 0.01, 0.2
    lift = u[0] + u[1] + mass * GRAVITY
    force = -lift * f.sin(x[2]), lift * f.cos(x[2])
    return [x[3], x[4], x[5], force[0] / mass, force[1] / mass - GRAVITY, arm * (u[1] - u[0]) / inertia]


def timed_integrator(f: Any, x: Any, u: Any) -> list[Any]:
    """Exact step of a double integrator whose third state is the duration of the step."""
    h = x[2]
    return [x[0] + h * x[1] + h**2 / 2 * u[0], x[1] + h * u[0], h]


def pendulum_rates(f: Any, x: Any, u: Any) -> list[Any]:
    """A rod of 1 kg and 1 m, upright at zero."""
    return [x[1], 3 * (u[0] + GRAVITY / 2 * f.sin(x[0]))]


def quadratic(goal: Sequence[float], weights: Sequence[float], force: float, dt: float, last: float) -> tuple[Any, Any]:
    """Running and final cost of the squared error, with the angles as they are."""

    def off(x: Any) -> Any:
        return sum(w * (x[i] - goal[i]) ** 2 for i, w in enumerate(weights) if w)

    return (lambda f, x, u: dt * (off(x) + force * sum(u[i] ** 2 for i in rates_size(u)))), (lambda f, x: last * off(x))


def upright(angle: int, weights: Sequence[float], force: float, dt: float, last: float) -> tuple[Any, Any]:
    """Running and final cost with 2 (1 - cos) of one angle."""

    def off(f: Any, x: Any) -> Any:
        rest = sum(w * x[i] ** 2 for i, w in enumerate(weights) if i != angle)
        return rest + weights[angle] * 2 * (1 - f.cos(x[angle]))

    return (lambda f, x, u: dt * (off(f, x) + force * u[0] ** 2)), (lambda f, x: last * off(f, x))


def problems() -> list[Planned]:
    """The nine."""
    pi = math.pi
    pole = upright(1, (1.0, 1.0, 0.1, 0.1), 0.01, 0.04, 50.0)
    up = (pi, 0.0, 0.0, 0.0)
    acrobot = quadratic(up, (1.0, 1.0, 0.1, 0.1), 0.1, 0.04, 100.0)
    pendubot = quadratic(up, (1.0, 1.0, 0.1, 0.1), 0.1, 0.03, 100.0)
    reach = quadratic((1.5, 1.0, 0.0, 0.0), (1.0, 1.0, 0.1, 0.1), 0.1, 0.02, 50.0)
    flexible = upright(2, (1.0, 0.0, 1.0, 0.02, 0.0, 0.001), 1e-3, 0.04, 50.0)
    rotor = quadratic((2.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 0.1, 0.1, 0.1, 0.01), 0.1, 0.05, 50.0)
    hang = upright(0, (1.0, 0.05), 0.05, 0.05, 20.0)
    arm_start = (-0.8, 0.9, 0.0, -1.2, 0.0, 0.8, 0.0, *(0.0,) * 7)
    arm_goal = (0.8, 0.9, 0.0, -1.2, 0.0, 0.8, 0.0, *(0.0,) * 7)
    joints = np.radians([170, 120, 170, 120, 170, 120, 175])

    def arm_cost(f: Any, x: Any, u: Any) -> Any:
        return 0.05 * sum(0.02 * u[i] ** 2 + 0.1 * x[7 + i] ** 2 for i in range(7))

    return [
        Planned("cart-pole", (0.0, pi, 0.0, 0.0), (0.0,) * 4, 50, Steps(pole_rates, 0.04), *pole, (10.0,),
                (-0.5, *(-np.inf,) * 3), (0.5, *(np.inf,) * 3)),
        Planned("acrobot", (0.0,) * 4, up, 60, Steps(two_links((1,)), 0.04, 2), *acrobot, (6.0,)),
        Planned("pendubot", (0.0,) * 4, up, 50, Steps(two_links((0,)), 0.03, 2), *pendubot, (6.0,)),
        Planned("two-link-reach", (-0.5, 2.0, 0.0, 0.0), (1.5, 1.0, 0.0, 0.0), 50,
                Steps(two_links((0, 1), 0.0), 0.02), *reach, (2.0, 2.0)),
        Planned("flexible-cart-pole", (0.0, 0.0, pi, 0.0, 0.0, 0.0), (0.0,) * 6, 50,
                Steps(flexible_rates, 0.04, 2), *flexible, (15.0,)),
        Planned("seven-axis-reach", arm_start, arm_goal, 30, accelerated, arm_cost,
                lambda f, x: 200.0 * tip_error(f, x) + 5.0 * sum(x[7 + i] ** 2 for i in range(7)), (15.0,) * 7,
                (*-joints, *(-2.0,) * 7), (*joints, *(2.0,) * 7), beyond_torques, clear_of_sphere),
        Planned("quadrotor-wall", (-2.0, 0.0, 0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0, 0.0, 0.0), 50,
                Steps(rotor_rates, 0.05), *rotor, (2.0, 2.0),
                states=lambda f, x: [1.0 - (x[0] / 0.3) ** 2 - (x[1] + 0.4) ** 2]),
        Planned("shortest-time", (0.0, 0.0, 0.05), (1.0, 0.0, 0.05), 40, timed_integrator, lambda f, x, u: x[2],
                lambda f, x: 0.0 * x[0], (1.0,), (-np.inf, -np.inf, 1e-3), (np.inf, np.inf, 1.0),
                end=lambda f, x: [x[0] - 1.0, x[1]], free=(False, False, True)),
        Planned("hanging-start", (pi, 0.0), (pi, 0.0), 60, Steps(pendulum_rates, 0.05), *hang, (2.5,), spread=0.01),
    ]  # fmt: skip


def guesses(problem: Planned) -> list[tuple[np.ndarray, np.ndarray]]:
    """States [N+1, n] and controls [N, m]: a straight line at rest, then lines with smooth random parts."""
    random, N = np.random.default_rng(0), problem.steps
    x0, goal, limit = (np.asarray(a, float) for a in (problem.x0, problem.goal, problem.limit))
    line = np.linspace(x0, goal, N + 1)
    way = np.maximum(np.abs(goal - x0), 0.3)
    pairs = [(line, np.zeros((N, len(limit))))]
    waves = np.sin(np.pi * np.arange(1, 6) * np.linspace(0, 1, N + 1)[:, None])
    for _ in range(GUESSES - 1):
        part_x = waves @ (random.normal(size=(5, len(x0))) / np.arange(1, 6)[:, None])
        part_u = waves[:-1] @ random.normal(size=(5, len(limit)))
        pairs.append((line + problem.spread * way * part_x, problem.spread * limit * part_u))
    return pairs
