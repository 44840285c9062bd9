"""Optimal control problem of any plant, with costs, box, discount and times from its natural scales.

The plant falls from its goal at the rate f, and a motor at its limit accelerates its coordinate by a:

    lambda = max(f, √(a / π))  1/s,    sizes r: π for a joint that turns freely, half the range of a limited one, else
                                       3 max(a, g) / lambda²

    q(x) = sum w π² sin²((θ - θ0)/2)  or  w (x - x0)²,  and v qd²,  + barriers of limited coordinates
    w = 1 for angles (1/2 with a motor), 5 / r² for slides,   v = 1 / lambda² and 2 / (lambda r)²
    g(u): cost of limited controls; half of all limits together cost effort π², if hanging costs π²

The box contains the whole circle or range, and rates up to 2.4 lambda, or for slides up to the reach of the motor.
Times of the fit and of the discount are multiples of 1 / lambda.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.action_costs import centred, limited_atan, stretched
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.problem import ControlProblem, checked, from_plant
from dln_jax.control.plants.plant import Layout
from dln_jax.control.state_space import field_of, holding_controls
from dln_jax.control.swing_up import nearest_equilibrium
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.nn.activations import softplus
from dln_jax.types import InputError, JointKind, Scalar

EFFORT = 0.25
"""Cost of half of all limits, relative to the cost of hanging."""
SHARE, HORIZON = 0.8, 40.0
"""Weight of a cost after the horizon, and the horizon in units of 1 / lambda."""
FASTEST = 2.4
"""Largest rates in the box, in units of lambda times the size of a joint."""
WALL, STEEPNESS = 0.8, 10.0
"""Start of a barrier, as a share of half the range, and its steepness in units of half the range."""
NEAR = 0.2
"""Largest angle from the goal that counts as up, rad."""
SLOWEST = 1e-6
"""Smallest lambda of a plant that moves, 1/s."""
MARGIN = 1e-3
"""Margin of the action cost beyond the limits."""
FOLDER = Path(__file__).parent / "mjcf"
"""MJCF files of desktop plants."""


@dataclass(frozen=True)
class OwnProblem:
    """All numbers of a problem as JSON values, independent of later defaults."""

    names: tuple[str, ...]
    joints: tuple[JointKind, ...]
    """Kinds of the coordinates."""
    actuation: tuple[tuple[float, ...], ...]
    limits: tuple[float, ...]
    """Largest controls [m], N m or N."""
    positions: tuple[tuple[float | None, float | None], ...]
    """Limits of the coordinates [d], rad or m; `None` for none."""
    goal: tuple[float, ...]
    """Posture [d], an equilibrium of the model."""
    hanging: tuple[float, ...]
    """Posture [d] near which the evaluation starts."""
    scale: float
    """lambda, 1/s."""
    weights: tuple[float, ...]
    """Weights of the squared deviations of the state [2 d]."""
    effort: float
    """Cost of half of all limits over π²."""
    box: tuple[float, ...]
    """Half widths [2 d] of the box around the goal, or around the middle of a range."""

    @property
    def turning(self) -> tuple[bool, ...]:
        """Mask of the coordinates that turn freely, on a circle."""
        return tuple(
            kind == "revolute" and low is None and high is None
            for kind, (low, high) in zip(self.joints, self.positions, strict=True)
        )

    @property
    def ranges(self) -> np.ndarray:
        """Limits of the coordinates [d, 2], infinite for none."""
        return np.array([(-np.inf if a is None else a, np.inf if b is None else b) for a, b in self.positions])


def own_problem(
    model: Dynamics | InverseForward,
    layout: Layout,
    *,
    effort: float | None = None,
    weights: Any = None,
    box: Any = None,
) -> OwnProblem:
    """Chooses the numbers of a problem from the scales of a plant.

    Args:
        model: smooth model of the plant.
        layout: motors, goal and limits.
        effort: by default `EFFORT`.
        weights: weights of the squared deviations [2 d]; angles of free joints enter as π sin(θ/2).
        box: half widths [2 d].

    Raises:
        InputError: the limits cannot hold the goal, the goal is not an equilibrium, numbers have the wrong count or
            sign, or the plant neither falls nor has a motor.
    """
    B, size = layout.actuation, layout.limits.control[:, 1]
    passive = np.flatnonzero((B == 0).all(axis=1))
    goal = np.asarray(layout.goal, float)
    if len(passive) and isinstance(model, Dynamics):
        goal = np.asarray(nearest_equilibrium(model, goal, passive.tolist()))
    held = np.abs(np.asarray(holding_controls(model, goal, B))) if isinstance(model, Dynamics) else np.zeros(len(size))
    if not (held < size).all():
        raise InputError(f"the goal takes controls of {held.tolist()}; the limits are {size.tolist()}; widen them")
    fall, acceleration = _rates(model, goal, B, size)
    scale = max(fall, math.sqrt(float(np.max(acceleration)) / math.pi))
    if not SLOWEST < scale < np.inf:
        raise InputError(f"the plant moves from its goal at the rate {scale:.3g}/s; expected gravity or a motor")
    angles = np.array([kind == "revolute" for kind in layout.joints])
    ranges = np.asarray(layout.limits.position, float)
    bounded = np.isfinite(ranges).all(axis=1)
    half = np.where(bounded, np.diff(ranges, axis=1)[:, 0] / 2, np.inf)
    sizes = np.where(angles, np.pi, 3 * np.maximum(acceleration, 9.81) / scale**2)
    sizes = np.where(bounded, np.minimum(half, np.where(angles, half, np.inf)), sizes)
    speed = FASTEST * scale * np.where(angles, 1.0, sizes)
    reached = np.where(acceleration > 0, 1.2 * np.sqrt(2 * acceleration * sizes), np.inf)
    speed = np.minimum(np.where(angles, speed, np.minimum(speed, reached)), layout.limits.rate)
    driven = acceleration > 0
    of_q = np.where(angles, np.where(driven, 0.5, 1.0), 5 / sizes**2)
    of_rates = np.where(angles, 1.0, 2 / sizes**2) / scale**2
    chosen = {
        "weights": (np.concatenate([of_q, of_rates]), weights),
        "box": (np.concatenate([sizes, speed]), box),
    }
    numbers = {name: _stated(name, usual, wish) for name, (usual, wish) in chosen.items()}
    if not np.isfinite(effort := EFFORT if effort is None else effort) or not effort > 0:
        raise InputError(f"effort is {effort}; expected a positive cost of half the limits, relative to hanging")
    return OwnProblem(
        names=tuple(layout.names),
        joints=tuple(layout.joints),
        actuation=tuple(map(tuple, B.tolist())),
        limits=tuple(size.tolist()),
        positions=tuple((_finite(low), _finite(high)) for low, high in ranges.tolist()),
        goal=tuple(goal.tolist()),
        hanging=tuple(np.asarray(layout.hanging, float).tolist()),
        scale=float(scale),
        weights=numbers["weights"],
        effort=float(effort),
        box=numbers["box"],
    )


def _rates(
    model: Dynamics | InverseForward, goal: np.ndarray, B: np.ndarray, size: np.ndarray
) -> tuple[float, np.ndarray]:
    """Returns the rate of falling from the goal, 1/s, and the accelerations [d] by each joint's motor at its limit."""
    field, d, still = field_of(model), len(goal), jnp.zeros(len(goal))

    def accelerations(q: Array, tau: Array) -> Array:
        return field(jnp.concatenate([q, still]), tau)[d:]

    q = jnp.asarray(goal)
    holding = jnp.linalg.lstsq(jax.jacfwd(accelerations, 1)(q, still), -accelerations(q, still))[0]
    stiffness, mobility = jax.jit(jax.jacfwd(accelerations, (0, 1)))(q, holding)
    fall = math.sqrt(max(float(np.max(np.real(np.linalg.eigvals(np.asarray(stiffness))))), 0.0))
    own = np.abs(np.diag(np.asarray(mobility)) * (np.abs(B) @ size))
    return fall, own


def _stated(name: str, usual: np.ndarray, wish: Any) -> tuple[float, ...]:
    """Returns positive numbers [2 d]; default: `usual`."""
    if wish is None:
        return tuple(usual.tolist())
    numbers = np.asarray(wish, float)
    if numbers.shape != usual.shape or not (np.isfinite(numbers) & (numbers > 0)).all():
        raise InputError(
            f"{name} are {numbers.tolist()}; expected {len(usual)} positive numbers, coordinates first, then rates"
        )
    return tuple(numbers.tolist())


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def own_plant(model: Dynamics | InverseForward, numbers: OwnProblem) -> ControlProblem:
    """Returns the control problem.

    Args:
        model: smooth model of the plant.
        numbers: from `own_problem`, for this model.

    Raises:
        InputError: numbers are missing, or do not fit the model; see `checked`.
    """
    d, scale = len(numbers.joints), numbers.scale
    one_each = ("names", "actuation", "positions", "goal", "hanging")
    for name, count in {**dict.fromkeys(one_each, d), "weights": 2 * d, "box": 2 * d}.items():
        if len(stated := getattr(numbers, name)) != count:
            raise InputError(f"{name} has {len(stated)} entries; expected {count} for {d} coordinates")
    motors = len(numbers.limits)
    if any(len(row) != motors for row in numbers.actuation):
        raise InputError(f"actuation is {numbers.actuation}; expected a column for each of {motors} limits")
    goal = np.concatenate([numbers.goal, np.zeros(d)])
    half, turning = np.asarray(numbers.box), np.array(numbers.turning)
    ranges = numbers.ranges
    bounded = np.isfinite(ranges).all(axis=1)
    middle = goal.copy()
    middle[:d][bounded] = ranges[bounded].mean(axis=1)
    # Limited joints move along a line, not on a circle.
    kinds: tuple[JointKind, ...] = tuple("revolute" if turns else "prismatic" for turns in turning)
    drift, actuation = from_plant(model, np.asarray(numbers.actuation))
    limit, tau = np.asarray(numbers.limits), 2 * (1 + MARGIN) / np.pi
    half_of_limits = -tau * math.log(math.cos(np.pi / 4 / (1 + MARGIN))) * len(limit)
    cost = stretched(limited_atan(1 + MARGIN, numbers.effort * np.pi**2 / half_of_limits), limit)
    problem = ControlProblem(
        drift, actuation, _state_cost(numbers, goal, turning, ranges), cost,
        -math.log(SHARE) * scale / HORIZON, middle - half, middle + half, kinds, goal,
    )  # fmt: skip
    with jax.enable_x64(True):
        a, B = jax.jit(lambda x: (drift(x), actuation(x)))(jnp.asarray(goal))
        u = np.linalg.lstsq(np.asarray(B), -np.asarray(a), rcond=None)[0]
        if np.max(np.abs(u / limit)) > 1e-9:
            problem = problem._replace(action_cost=centred(cost, u))
        return checked(problem, tolerance=1e-6 * (1 + scale**2))


def _state_cost(
    numbers: OwnProblem, goal: np.ndarray, turning: np.ndarray, ranges: np.ndarray
) -> Callable[[Array], Scalar]:
    weights, d = numbers.weights, len(numbers.joints)
    limited = [k for k in range(d) if np.isfinite(ranges[k]).all()]

    def barrier(position: Any, k: int) -> Any:
        centre, half = ranges[k].mean(), (ranges[k][1] - ranges[k][0]) / 2
        height = 5 * weights[k] * (WALL * half) ** 2
        return height * softplus.first(STEEPNESS * (jnp.abs(position - centre) / half - WALL))

    def cost(x: Array) -> Scalar:
        total = jnp.zeros((), x.dtype)
        for k in range(2 * d):
            off = x[k] - goal[k]
            total += weights[k] * (math.pi * jnp.sin(off / 2) if k < d and turning[k] else off) ** 2
        for k in limited:
            total += barrier(x[k], k) - barrier(goal[k], k)
        return total

    return cost


def own_settings(numbers: OwnProblem) -> tuple[Iteration, float]:
    """Returns the settings of the iteration, with times in units of 1 / lambda, and the network's factor on V."""
    unit = 1 / numbers.scale
    return Iteration(
        iterations=80, starts=2048, kept=6, steps=250, slope_weight=0.1, floor=0.01, followed=4.0,
        dt=0.1 * unit, seconds=12 * unit, first_memory=0.8 * unit, memory=HORIZON * unit,
    ), 10 * math.pi**2 * unit  # fmt: skip


def described(numbers: OwnProblem) -> list[str]:
    """Returns lines of text with the numbers of a problem."""

    def listed(values: Sequence[float], units: Mapping[str, str]) -> str:
        pairs = zip(numbers.names, numbers.joints, values, strict=True)
        return ", ".join(f"{name} {value:.3g} {units[kind]}".rstrip() for name, kind, value in pairs)

    d = len(numbers.joints)
    motors = ", ".join(
        f"{numbers.names[int(np.flatnonzero(column)[0])]} {limit:.3g}"
        for column, limit in zip(np.asarray(numbers.actuation).T, numbers.limits, strict=True)
    )
    place, speed = {"revolute": "rad", "prismatic": "m"}, {"revolute": "rad/s", "prismatic": "m/s"}
    plain = {"revolute": "", "prismatic": "/m²"}
    return [
        f"goal {listed(numbers.goal, place)}; largest controls {motors} N m or N; scale {numbers.scale:.3g}/s",
        f"box, half widths: {listed(numbers.box[:d], place)}; {listed(numbers.box[d:], speed)}",
        f"cost: weights {listed(numbers.weights[:d], plain)}, of rates "
        f"{', '.join(f'{value:.3g}' for value in numbers.weights[d:])}; effort {numbers.effort:.3g}, discount "
        f"{-math.log(SHARE) * numbers.scale / HORIZON:.3g}/s",
    ]
