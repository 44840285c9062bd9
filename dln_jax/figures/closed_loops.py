"""Closed loops: traces with limits, and animated GIFs of the moving machine beside its control."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from dln_jax.control.closed_loop import ClosedLoopRun
from dln_jax.figures import style
from dln_jax.types import InputError, JointKind, require_positive

MOST_SHOWN = 30
"""Largest number of runs whose traces are drawn."""
Drawing = Callable[[Axes, Float[np.ndarray, "T d"], int], Callable[[int], None]]
"""(axis, q of all samples, number of samples in the tip's trace) -> function that draws a sample."""
BODY, POLE, TIP, GROUND = "#3b4252", "#2e6fa7", style.VERMILLION, "0.72"
TRACE = 0.8
"""Duration of the tip's trace in s."""
VIEW = np.deg2rad([35.0, 22.0])
"""Azimuth and elevation of the view of machines in space, rad."""


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
            values, level = np.arctan2(np.sin(values - level), np.cos(values - level)), 0.0
            jumps = np.abs(np.diff(values, prepend=values[:, :1])) > np.pi
            values = np.where(jumps, np.nan, values)
            angle_ticks(axis.yaxis)
            axis.set_ylim(-1.05 * np.pi, 1.05 * np.pi)
        _curves(axis, t, values)
        axis.axhline(level, **dashed)
        name = names[joint] if names else f"q{joint + 1}"
        axis.set_ylabel(f"{name}, {'rad' if kind == 'revolute' else 'm'}")
    for control, axis in enumerate(axes[d : d + m, 0]):
        axis.plot(t[:-1], u[0, :, control], color=style.BLUE, linewidth=1.6, drawstyle="steps-post")
        for limit in filter(np.isfinite, [np.broadcast_to(limit, m)[control] for limit in limits]):
            axis.axhline(limit, color=style.VERMILLION, linewidth=1.2)
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


def _curves(axis: Axes, t: np.ndarray, values: np.ndarray) -> None:
    """Draws curves [K, T] with the first in front."""
    axis.plot(t, values[:0:-1].T, color=style.SKY, linewidth=0.6)
    axis.plot(t, values[0], color=style.BLUE, linewidth=1.6)


def angle_ticks(side: Axis) -> None:
    """Puts ticks at multiples of pi / 2 over the full circle."""
    side.set_ticks(np.pi / 2 * np.arange(-2, 3), ["-π", "-π/2", "0", "π/2", "π"])


def cart_pole_drawing(length: float) -> Drawing:
    """Returns the drawing of a cart-pole with q = (cart, pole from upright) in m and rad; `length` of the pole in m."""

    def prepare(axis: Axes, q: np.ndarray, trail: int) -> Callable[[int], None]:
        wide, tall = 0.55 * length, 0.28 * length
        tip = np.stack([q[:, 0] + length * np.sin(q[:, 1]), length * np.cos(q[:, 1])], axis=1)
        low, high = q[:, 0].min() - 1.25 * length, q[:, 0].max() + 1.25 * length
        axis.plot([low, high], [-tall / 2 - 0.07 * length] * 2, color=GROUND, linewidth=2.5, zorder=0)
        cart = Rectangle((0, 0), wide, tall, facecolor=BODY, edgecolor="none", zorder=2)
        wheels = [Circle((0, 0), 0.07 * length, facecolor="0.45", zorder=3) for _ in range(2)]
        for patch in (cart, *wheels):
            axis.add_patch(patch)
        moving = _rod(axis, tip, trail)
        axis.set(xlim=(low, high), ylim=(-1.25 * length, 1.25 * length), aspect="equal")
        axis.set_axis_off()

        def show(index: int) -> None:
            x = q[index, 0]
            cart.set_xy((x - wide / 2, -tall / 2))
            for wheel, side in zip(wheels, (-1, 1), strict=True):
                wheel.set_center((x + side * 0.3 * wide, -tall / 2))
            moving(index, np.array([x, 0.0]))

        return show

    return prepare


def rotary_pendulum_drawing(arm: float, pole: float) -> Drawing:
    """Returns the drawing of a rotary pendulum, q = (arm, pole from upright) in rad, seen obliquely; lengths in m."""

    def prepare(axis: Axes, q: np.ndarray, trail: int) -> Callable[[int], None]:
        hinge = arm * _direction(q[:, 0])
        across, upright = _direction(q[:, 0] + np.pi / 2), np.array([0.0, 0.0, 1.0])
        tip = hinge + pole * (np.sin(q[:, 1:]) * across + np.cos(q[:, 1:]) * upright)
        ring = _direction(np.linspace(0, 2 * np.pi, 120))
        floor, reach = np.array([0.0, 0.0, -1.1 * pole]), float(np.hypot(arm, pole))
        disc = _seen(reach * ring + floor)
        axis.fill(*disc.T, facecolor="0.95", edgecolor="none", zorder=0)
        axis.plot(*_seen(arm * ring).T, color="0.85", linewidth=1.0, zorder=1)
        axis.plot(*_seen([floor, np.zeros(3)]).T, color=GROUND, linewidth=9, solid_capstyle="butt", zorder=1)
        (shadow,) = axis.plot([], [], color="0.82", linewidth=4, solid_capstyle="round", zorder=0.5)
        (beam,) = axis.plot([], [], color=BODY, linewidth=7, solid_capstyle="round", zorder=3)
        axis.plot(0, 0, "o", color=BODY, markersize=13, zorder=3)
        flat, hinges = _seen(tip), _seen(hinge)
        moving = _rod(axis, flat, trail)
        top = float(flat[:, 1].max()) + 0.12 * reach
        axis.set(xlim=(-1.1 * reach, 1.1 * reach), ylim=(disc[:, 1].min() - 0.02 * reach, top), aspect="equal")
        axis.set_axis_off()

        def show(index: int) -> None:
            beam.set_data(*np.stack([np.zeros(2), hinges[index]]).T)
            fallen = np.stack([np.zeros(3), hinge[index], tip[index]]) * (1.0 - upright) + floor
            shadow.set_data(*_seen(fallen).T)
            moving(index, hinges[index])

        return show

    return prepare


def write_closed_loop_gif(
    path: Path,
    drawing: Drawing,
    t: Any,
    q: Any,
    u: Any,
    *,
    limits: tuple[float, float] = (-np.inf, np.inf),
    unit: str = "N",
    title: str = "",
    frames_per_second: float = 25.0,
) -> None:
    """Writes a run in real time: the moving machine and its control.

    Args:
        drawing: drawing of the machine, such as `cart_pole_drawing(length)`.
        t: times [T], s, with a spacing below that of the frames.
        q: coordinates [T, d].
        u: control [T], held constant from each time on.
        limits: limits of the control, drawn in red.
        frames_per_second: frame rate of the GIF, which plays the run in real time.

    Raises:
        InputError: arrays have different lengths, or coordinates are not finite.
    """
    require_positive(frames_per_second=frames_per_second)
    t, q, u = np.asarray(t), np.asarray(q), np.asarray(u)
    if not len(t) == len(q) == len(u) > 1 or not np.isfinite(q).all():
        raise InputError(f"there are {len(t)} times, {len(q)} states, {len(u)} controls; expected as many, all finite")
    samples = np.searchsorted(t, np.arange(t[0], t[-1], 1 / frames_per_second) - 1e-9)
    figure, [[machine, trace]] = style.figure(1, 2, width=6.4, height=2.9, dpi=style.FILM_DPI, width_ratios=[1.5, 1.0])
    machine.grid(False)
    show_machine = drawing(machine, q, int(np.searchsorted(t, t[0] + TRACE)))
    trace.plot(t, u, color="0.85", linewidth=1.0, drawstyle="steps-post")
    (line,) = trace.plot([], [], color=style.BLUE, linewidth=1.4, drawstyle="steps-post")
    (now,) = trace.plot([], [], "o", color=style.BLUE, markersize=4)
    for limit in filter(np.isfinite, limits):
        trace.axhline(limit, color=style.VERMILLION, linewidth=1.2)
    trace.set(xlabel="t, s", ylabel=f"control, {unit}", xlim=(t[0], t[-1]))
    trace.margins(y=0.12)

    def show(index: int) -> None:
        show_machine(index)
        line.set_data(t[: index + 1], u[: index + 1])
        now.set_data([t[index]], [u[index]])

    style.write_gif(path, figure, show, t, frames=samples.tolist(), frames_per_second=frames_per_second, title=title)


def _rod(axis: Axes, tip: np.ndarray, trail: int) -> Callable[[int, np.ndarray], None]:
    """Draws a pole with a bob and its trace; returns a function that draws a sample from the position of the foot."""
    (trace,) = axis.plot([], [], color=TIP, linewidth=1.2, alpha=0.45, zorder=1.5)
    (pole,) = axis.plot([], [], color=POLE, linewidth=5, solid_capstyle="round", zorder=4)
    (bob,) = axis.plot([], [], "o", color=TIP, markersize=9, zorder=5)
    (pin,) = axis.plot([], [], "o", color="white", markersize=3.5, zorder=6)

    def show(index: int, foot: np.ndarray) -> None:
        trace.set_data(*tip[max(0, index - trail) : index + 1].T)
        pole.set_data(*np.stack([foot, tip[index]]).T)
        bob.set_data(*tip[index : index + 1].T)
        pin.set_data(*foot[:, None])

    return show


def _direction(angle: np.ndarray) -> np.ndarray:
    """Returns horizontal unit vectors [..., 3]."""
    return np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)


def _seen(points: Any) -> np.ndarray:
    """Projects points in space [..., 3] orthographically to the drawing plane [..., 2]."""
    azimuth, elevation = VIEW
    right, back = _direction(azimuth), _direction(azimuth + np.pi / 2)
    up = np.sin(elevation) * back + np.array([0.0, 0.0, np.cos(elevation)])
    return np.asarray(points) @ np.stack([right, up], axis=1)
