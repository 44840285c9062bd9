"""Figures of closed loops: traces with limits, and the phase plane with a regulator's region."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter

from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.figures import style
from dln_jax.types import InputError, JointKind

LIMIT = style.VERMILLION
MOST_SHOWN = 30
"""Largest number of runs whose traces are drawn."""


def closed_loop_traces(
    runs: ClosedLoopRun,
    joints: tuple[JointKind, ...],
    *,
    names: tuple[str, ...] | None = None,
    goal: Any = None,
    limits: tuple[Any, Any] = (-np.inf, np.inf),
    unit: str = "N or N m",
    energy: Any = None,
    goal_energy: float | None = None,
) -> Figure:
    """Coordinates and energy of runs over time, the first run in front, with its controls between their limits.

    Args:
        runs: K runs along a leading axis, for example from `vmap` of `simulate`.
        joints: kinds of the joints; angles are shown relative to the goal, in (-pi, pi].
        goal: state [2 d], drawn dashed; zero by default.
        limits: limits of the controls, [m] or one for all, drawn in red.
        energy: energy along the runs [K, T], J.
        goal_energy: energy at the goal, J, drawn dashed.

    Raises:
        InputError: runs lack the leading axis, or there are not as many names as coordinates.
    """
    x, u, d = np.asarray(runs.x), np.asarray(runs.u), len(joints)
    if x.ndim != 3 or x.shape[2] != 2 * d or (names is not None and len(names) != d):
        raise InputError(f"x has shape {x.shape} for {d} joints; expected [K, T, 2 d], and a name for each")
    t = np.asarray(runs.t).reshape(-1, x.shape[1])[0]
    goal, m = np.zeros(2 * d) if goal is None else np.asarray(goal), u.shape[2]
    rows = d + m + (energy is not None)
    figure, axes = style.figure(rows, 1, height=1.25 * rows + 0.6, sharex=True)
    dashed = {"color": "0.3", "linestyle": "--", "linewidth": 0.9}
    for joint, (axis, kind) in enumerate(zip(axes[:d, 0], joints, strict=True)):
        values, level = x[:MOST_SHOWN, :, joint], goal[joint]
        if kind == "revolute":
            values, level = _wrapped(values - level), 0.0
            angle_ticks(axis.yaxis)
            axis.set_ylim(-1.05 * np.pi, 1.05 * np.pi)
        _curves(axis, t, values, turning=kind == "revolute")
        axis.axhline(level, **dashed)
        name = names[joint] if names else f"q{joint + 1}"
        axis.set_ylabel(f"{name}, {'rad' if kind == 'revolute' else 'm'}")
    for control, axis in enumerate(axes[d : d + m, 0]):
        axis.plot(t[:-1], u[0, :, control], color=style.BLUE, linewidth=1.6, drawstyle="steps-post")
        for limit in limits:
            if np.isfinite(level := np.broadcast_to(limit, m)[control]):
                axis.axhline(level, color=LIMIT, linewidth=1.2)
        axis.set_ylabel(f"control, {unit}" if m == 1 else f"u{control + 1}, {unit}")
        axis.margins(y=0.15)
    if energy is not None:
        factor, joules = style.prefixed(float(np.nanmax(np.abs(energy))), "J")
        _curves(axes[-1, 0], t, np.asarray(energy)[:MOST_SHOWN] / factor)
        if goal_energy is not None:
            axes[-1, 0].axhline(goal_energy / factor, **dashed)
        axes[-1, 0].set_ylabel(f"energy, {joules}")
    axes[-1, 0].set(xlabel="t, s", xlim=(t[0], t[-1]))
    figure.align_ylabels()
    return figure


def phase_portrait(
    angle: Any,
    rate: Any,
    *,
    energy: tuple[Any, Any, Any] | None = None,
    goal_energy: float | None = None,
    caught: tuple[Any, float] | None = None,
) -> Figure:
    """Closed loops in the plane of an angle from upright and its rate, over energy levels, with the regulator's region.

    Args:
        angle: angles of the runs [K, T], rad; drawn from -pi to pi.
        rate: their rates [K, T], rad/s.
        energy: angles [a], rates [b] and the energy [b, a] on that grid, drawn as levels.
        goal_energy: energy of the dashed level, along which the pole swings up by itself.
        caught: S [2, 2] and a level; the regulator takes over where xᵀ S x is smaller.
    """
    figure, [[axis]] = style.figure(height=4.2)
    angle, rate = _wrapped(np.asarray(angle)), np.asarray(rate)
    if energy is not None:
        axis.contourf(*energy, levels=18, cmap="Greys", alpha=0.35, zorder=0)
        if goal_energy is not None:
            axis.contour(*energy, levels=[goal_energy], colors="0.25", linestyles="--", linewidths=1.2)
    for number in reversed(range(len(angle[:MOST_SHOWN]))):
        q, qd = angle[number], rate[number]
        colour, width, alpha, size = (style.SKY, 0.7, 0.6, 3) if number else (style.BLUE, 1.8, 1.0, 6)
        axis.plot(_with_gaps(q), qd, color=colour, linewidth=width, alpha=alpha)
        axis.plot(q[0], qd[0], "o", color=colour, markersize=size)
    if caught is not None:
        axis.fill(*_ellipse(*caught), facecolor=style.GREEN, edgecolor=style.GREEN, alpha=0.45, zorder=4)
        axis.annotate(
            "the regulator\ntakes over", (0, 0), (0.5, 0.93), xycoords="data", textcoords="axes fraction",
            ha="center", va="top", fontsize=style.SMALL, color="#00563f",
            arrowprops={"arrowstyle": "-", "color": style.GREEN, "linewidth": 0.8},
        )  # fmt: skip
    angle_ticks(axis.xaxis)
    room = 1.12 * float(np.nanmax(np.abs(rate)))
    axis.set(xlim=(-np.pi, np.pi), ylim=(-room, room), xlabel="angle from upright, rad", ylabel="rate, rad/s")
    axis.grid(False)
    return figure


def _curves(axis: Axes, t: np.ndarray, values: np.ndarray, *, turning: bool = False) -> None:
    """Draws curves with the first in front; angles have gaps where they wrap."""
    for number in reversed(range(len(values))):
        colour, width = (style.SKY, 0.6) if number else (style.BLUE, 1.6)
        axis.plot(t, _with_gaps(values[number]) if turning else values[number], color=colour, linewidth=width)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def _with_gaps(angle: np.ndarray) -> np.ndarray:
    """Returns angles with NaN where a wrapped angle jumps by a full turn."""
    return np.where(np.abs(np.diff(angle, prepend=angle[0])) > np.pi, np.nan, angle)


def angle_ticks(side: Axis) -> None:
    """Puts ticks at multiples of pi / 2 over the full circle."""
    side.set_major_locator(FixedLocator([-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi]))
    names = {-2: "-π", -1: "-π/2", 0: "0", 1: "π/2", 2: "π"}
    side.set_major_formatter(FuncFormatter(lambda value, _: names[round(2 * value / np.pi)]))


def _ellipse(S: Any, level: float) -> np.ndarray:
    """Returns the curve xᵀ S x = level [2, 100]."""
    turn = np.linspace(0, 2 * np.pi, 100)
    sizes, axes = np.linalg.eigh(np.asarray(S))
    return axes @ (np.sqrt(level / sizes)[:, None] * np.stack([np.cos(turn), np.sin(turn)]))
