"""A plant of any origin to swing up: four callables, and the facts known beforehand.

The callables are impure, like hardware. `act` sends the controls and returns at the next sample, at once for a
simulated plant. `guarded` stops a plant at its limits, and `run` closes the loop. `simulated` makes a plant from the
step function of any simulator, with the noise, the resolution and the delay of hardware.
"""

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.control.closed_loop import Hardware, encoded
from dln_jax.control.state_space import field_of, integrated
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.types import InputError, JointKind, Needs, require_positive

TURNS = 8
"""Number of initial angles of a joint for the search of the highest and the lowest posture."""
LEVEL = 1e-3
"""Smallest energy change by a passive joint that counts as gravity, as a share of the energy range."""


class Limits(NamedTuple):
    """Limits of safe operation; a plant outside them is stopped."""

    control: Float[np.ndarray, "m 2"]
    """Lower and upper limits of the motors, N m or N; finite."""
    position: Float[np.ndarray, "d 2"]
    """Lower and upper limits of the coordinates, such as the ends of a rail, rad or m; infinite for none."""
    rate: Float[np.ndarray, " d"]
    """Largest rates, 1/s or m/s; infinite for none."""
    stopping: float = 0.0
    """Braking time, s: at its present rate the plant must stay within the positions for this time."""
    late: float = 2.0
    """Largest time between two answers, in samples."""


class Layout(NamedTuple):
    """Facts about a plant known before it moves; masses and lengths are not needed."""

    joints: tuple[JointKind, ...]
    actuation: Float[np.ndarray, "d m"]
    """tau = actuation u; every motor drives one coordinate."""
    goal: Float[np.ndarray, " d"]
    """Posture to hold, an equilibrium to within a few hundredths of a radian."""
    hanging: Float[np.ndarray, " d"]
    """Posture of the plant at rest, and at a start."""
    rate: float
    """Sampling rate, Hz."""
    limits: Limits
    names: tuple[str, ...] = ()

    @property
    def needs(self) -> Needs:
        """Terms that a model of the plant needs."""
        return Needs(joints=self.joints, actuation=tuple(map(tuple, np.asarray(self.actuation, float).tolist())))


class Plant(NamedTuple):
    """A plant as four callables."""

    layout: Layout
    reset: Callable[[], None]
    """Brings the plant to rest near hanging."""
    read: Callable[[], Any]
    """() -> measured coordinates [d]; angles may be wrapped."""
    act: Callable[[Any], None]
    """Controls u [m] -> nothing; returns at the time of the next sample."""
    time: Callable[[], float]
    """() -> time in s, by the plant's clock."""
    kick: Callable[[Any], None] | None = None
    """Adds to the rates [d], like a push; `None` if the plant cannot."""


SPREAD = 0.1
"""Standard deviation of the passive coordinates at a start, rad or m."""
ACTIVE_SPREAD = 0.02
"""The same for the coordinates with a motor."""
ROOM = 0.2
"""Least distance of the goal from the limits of a revolute joint, rad: the tolerance of a plant that is up."""


def layout(
    joints: Sequence[str],
    actuated: Sequence[int],
    *,
    goal: Any,
    hanging: Any,
    rate: float,
    control: Any,
    position: Any = None,
    speed: Any = np.inf,
    stopping: float = 0.0,
    late: float = 2.0,
    names: Sequence[str] = (),
    passive: bool = True,
) -> Layout:
    """Returns a checked layout.

    Args:
        joints: kinds, "revolute" or "prismatic" [d].
        actuated: numbers of the coordinates with a motor, from 0.
        goal: posture to hold [d], rad or m.
        hanging: posture at rest [d].
        rate: sampling rate, Hz.
        control: largest size of the controls, one for all motors or one each, N m or N.
        position: limits [d, 2], rad or m; by default none.
        speed: largest rates, one for all or one each, 1/s or m/s.
        stopping: as `Limits.stopping`.
        late: as `Limits.late`.
        names: names of the coordinates; by default joint_0, joint_1, ...
        passive: require a coordinate without a motor, as for a swing-up.

    Raises:
        InputError: shapes do not agree, a motor's coordinate does not exist, there is no motor or no passive
            coordinate, a limit is not positive, `late` is at most one sample, a posture is outside the limits, or the
            goal of a swing-up is at the end of a range.
    """
    require_positive(rate=rate)
    if not late > 1:
        raise InputError(f"late is {late} samples; expected more than 1, because answers come once per sample")
    d, chosen = len(joints), sorted(set(actuated))
    names = tuple(names) or tuple(f"joint_{k}" for k in range(d))
    if any(not 0 <= k < d for k in chosen):
        raise InputError(f"actuated is {list(actuated)}; expected numbers of coordinates from 0 to {d - 1}")
    if not chosen or (passive and len(chosen) == d):
        which = "no joint has a motor" if not chosen else f"all {d} joints have a motor"
        raise InputError(f"{which}; a swing-up needs a motor and a passive joint")
    B = np.eye(d)[:, chosen]
    size = _sized("control", control, len(chosen))
    if not (np.isfinite(size) & (size > 0)).all():
        raise InputError(f"control is {size.tolist()}; expected finite, positive limits of the motors, N m or N")
    ranges = np.tile([-np.inf, np.inf], (d, 1)) if position is None else np.asarray(position, float)
    if ranges.shape != (d, 2) or not (ranges[:, 0] < ranges[:, 1]).all():
        raise InputError(f"position is {ranges.tolist()}; expected lower and upper limits of {d} coordinates")
    rates = _sized("speed", speed, d)
    if not (rates > 0).all() or not stopping >= 0:
        raise InputError(f"speed is {rates.tolist()} and stopping {stopping}; expected positive rates and a time >= 0")
    needs = Needs(joints=tuple(joints))  # checks the kinds
    postures = {"goal": _sized("goal", goal, d), "hanging": _sized("hanging", hanging, d)}
    for name, q in postures.items():
        if not np.isfinite(q).all() or (q < ranges[:, 0]).any() or (q > ranges[:, 1]).any():
            raise InputError(f"{name} is {q.tolist()}, outside the limits {ranges.tolist()}; choose a posture inside")
    room = np.min(np.abs(ranges - postures["goal"][:, None]), axis=1)
    least = np.where([kind == "revolute" for kind in needs.joints], ROOM, 0.0)
    if passive and (room <= least).any():
        k = int(np.argmax(room <= least))
        raise InputError(
            f"the goal of '{names[k]}', {postures['goal'][k]:.4g}, is at the end of its range of {ranges[k, 0]:.4g} to "
            f"{ranges[k, 1]:.4g}; a swing-up needs room on both sides: widen the range, or make the joint continuous"
        )
    limits = Limits(np.stack([-size, size], axis=1), ranges, rates, stopping, late)
    return Layout(needs.joints, B, postures["goal"], postures["hanging"], float(rate), limits, names)


def _sized(name: str, value: Any, size: int) -> np.ndarray:
    try:
        return np.array(np.broadcast_to(np.asarray(value, float), size))
    except ValueError:
        raise InputError(f"{name} is {value}; expected a number, or {size} numbers") from None


def simulated(
    layout: Layout,
    begin: Callable[[np.ndarray], None],
    coordinates: Callable[[], Any],
    advance: Callable[[np.ndarray], None],
    *,
    kick: Callable[[np.ndarray], None] | None = None,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a simulated plant, advanced by one sample at a time from random starts near hanging.

    Args:
        layout: layout of the plant, with the limits of the controls.
        begin: (posture [d]) -> nothing; puts the simulator there, at rest.
        coordinates: () -> the true q [d].
        advance: (controls that act [m]) -> nothing; advances the simulator by a sample.
        kick: (rates [d]) -> nothing; adds them to the rates of the simulator.
        hardware: noise, resolution and delay; its limits are not used.
        seed: seed of the starts and the noise.
    """
    random = np.random.default_rng([seed, 29])
    d, m = layout.actuation.shape
    queue: deque[np.ndarray] = deque()
    count = [0]

    def reset() -> None:
        count[0] = 0
        queue.clear()
        queue.extend([np.zeros(m)] * hardware.delay)
        begin(layout.hanging + spread_of(layout) * random.normal(size=d))

    def read() -> np.ndarray:
        return encoded(hardware, np.asarray(coordinates(), float), random.normal(size=d))

    def act(u: Any) -> None:
        queue.append(np.asarray(u, float))
        advance(queue.popleft() + hardware.control_noise * random.normal(size=m))
        count[0] += 1

    return Plant(layout, reset, read, act, lambda: count[0] / layout.rate, kick)


def spread_of(layout: Layout) -> np.ndarray:
    """Returns the standard deviations of the coordinates at a start [d]."""
    return np.where((layout.actuation != 0).any(axis=1), ACTIVE_SPREAD, SPREAD)


def plant_of(
    model: Dynamics | InverseForward,
    layout: Layout,
    *,
    substeps: int = 2,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a plant that simulates a model of this library, such as a scene with friction.

    Args:
        model: for example `dynamics(scene.closed_form)`.
        layout: layout of the plant.
        substeps: Runge-Kutta steps per sample.
        hardware: as for `simulated`.
        seed: as for `simulated`.
    """
    step = jax.jit(integrated(field_of(model, layout.actuation), 1 / layout.rate, substeps=substeps))
    state = [np.zeros(2 * len(layout.joints))]

    def begin(q: np.ndarray) -> None:
        state[0] = np.concatenate([q, np.zeros_like(q)])

    def advance(u: np.ndarray) -> None:
        state[0] = np.asarray(step(state[0], u))

    def kick(rates: np.ndarray) -> None:
        state[0] = state[0] + np.concatenate([np.zeros_like(rates), rates])

    return simulated(
        layout, begin, lambda: state[0][: len(layout.joints)], advance, kick=kick, hardware=hardware, seed=seed
    )  # fmt: skip


def extremes(
    potential: Callable[[np.ndarray], float],
    joints: Sequence[str],
    driven: Sequence[int],
    ranges: Float[np.ndarray, "d 2"],
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the postures [d] of least and greatest potential energy.

    Slides stay in the middle of their ranges, or at zero without a range, because the energy is linear in them. Angles
    without effect stay at zero. Without gravity both are the posture nearest to zero.

    Args:
        potential: q [d] -> potential energy, J.
        joints: kinds.
        driven: numbers of the joints with a motor.
        ranges: limits of the coordinates, infinite for none.

    Raises:
        InputError: the limits exclude every posture of the search, a passive joint is a slide, or gravity has no effect
            on it.
    """
    from scipy.optimize import minimize

    turns = 2 * np.pi / TURNS * np.arange(1 - TURNS // 2, TURNS // 2 + 1)
    choices = [
        [turn for turn in turns if low <= turn <= high]
        if kind == "revolute"
        else [(low + high) / 2 if np.isfinite([low, high]).all() else 0.0]
        for kind, (low, high) in zip(joints, ranges, strict=True)
    ]
    hinges = np.array([kind == "revolute" for kind in joints])
    grid = sorted(map(np.array, itertools.product(*choices)), key=lambda q: float(np.abs(q).sum()))
    if not grid:
        raise InputError("the limits of the joints exclude every posture of the search; give goal and hanging")
    energies = np.array([potential(q) for q in grid])
    size = float(np.ptp(energies))
    for k in sorted(set(range(len(joints))) - set(driven)):
        if not hinges[k]:
            raise InputError(f"nothing holds the passive slide {k}; expected only hinges without a motor")
        moved = [
            abs(potential(q + np.pi / 2 * np.eye(len(joints))[k]) - e) for q, e in zip(grid, energies, strict=True)
        ]
        if not max(moved) > LEVEL * max(size, 1e-12):
            raise InputError(f"gravity does not move the passive joint {k}; expected a joint that can hang and stand")
    postures = []
    for sign in (1.0, -1.0):
        ties = np.flatnonzero(sign * energies <= (sign * energies).min() + 1e-9 * max(size, 1e-12))
        start, options = grid[ties[0]], {"gtol": 1e-7}
        energy = lambda q: sign * potential(np.where(hinges, q, start)) / (size or 1.0)  # noqa: B023, E731
        best = minimize(energy, start, method="BFGS", options=options)
        postures.append(np.clip(np.where(np.abs(best.x) < 1e-9, 0.0, best.x), ranges[:, 0], ranges[:, 1]))
    return postures[0], postures[1]
