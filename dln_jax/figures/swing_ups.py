"""Pictures of swing-ups of a cart-pole or a rotary pendulum: traces with limits, and a film of one run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.animations import DPI, write_gif
from dln_jax.types import InputError

SHOWN = 30
"""Runs that are drawn behind the first."""
FRAMES_PER_SECOND = 25.0
TAIL = 0.3
"""s, of the tip's way that a film shows."""
UP_COLOUR = style.GREEN


class Traces(NamedTuple):
    """Runs [n, N+1] of one plant; the first is drawn over the others."""

    t: Float[np.ndarray, " N+1"]
    position: Float[np.ndarray, "n N+1"]
    """Of the driven coordinate, m or rad."""
    angle: Float[np.ndarray, "n N+1"]
    """Of the pole from upright, rad."""
    control: Float[np.ndarray, "n N"]
    """N or N m."""
    energy: Float[np.ndarray, "n N+1"]
    """Of the passive part less that of the goal, by the model, J."""
    limit: float
    units: tuple[str, str]
    """Of the driven coordinate and of the control."""


def traces_figure(traces: Traces, *, title: str, up: float) -> Figure:
    """Angle, driven coordinate, control within its limits and energy against the goal's, over time."""
    figure, axes = style.figure(4, 1, height=7.4, sharex=True)
    of_position, of_control = traces.units
    factor, joule = style.prefixed(float(np.nanmax(np.abs(traces.energy))), "J")
    turned = np.degrees(np.arctan2(np.sin(traces.angle), np.cos(traces.angle)))
    rows: list[tuple[Axes, np.ndarray, str, str]] = [
        (axes[0, 0], _without_jumps(turned), style.BLUE, "pole from upright, °"),
        (axes[1, 0], traces.position, style.PURPLE, f"driven joint, {of_position}"),
        (axes[2, 0], np.concatenate([traces.control, traces.control[:, -1:]], axis=1), style.VERMILLION,
         f"control, {of_control}"),
        (axes[3, 0], traces.energy / factor, style.ORANGE, f"energy less goal's, {joule}"),
    ]  # fmt: skip
    for axis, values, colour, label in rows:
        for other in values[1 : SHOWN + 1]:
            axis.plot(traces.t, other, color=colour, linewidth=0.5, alpha=0.12)
        axis.plot(traces.t, values[0], color=colour, linewidth=1.3)
        axis.set_ylabel(label)
    band = np.degrees(up)
    axes[0, 0].axhspan(-band, band, color=UP_COLOUR, alpha=0.2, linewidth=0)
    axes[0, 0].set(ylim=(-190, 190), yticks=[-180, -90, 0, 90, 180])
    for side in (-1, 1):
        axes[2, 0].axhline(side * traces.limit, color="0.3", linewidth=0.9, linestyle="--")
    axes[2, 0].set_ylim(-1.15 * traces.limit, 1.15 * traces.limit)
    axes[3, 0].axhline(0.0, color=UP_COLOUR, linewidth=1.0)
    axes[3, 0].set(xlabel="time, s", xlim=(0.0, float(traces.t[-1])))
    style.title(axes[0, 0], title)
    figure.align_ylabels()
    return figure


def _without_jumps(degrees: np.ndarray) -> np.ndarray:
    """NaN where an angle goes from one end of the circle to the other, so that no line is drawn there."""
    jumps = np.abs(np.diff(degrees, axis=1, prepend=degrees[:, :1])) > 180
    return np.where(jumps, np.nan, degrees)


def write_swing_up_gif(
    path: Path,
    kind: str,
    t: Float[np.ndarray, " T"],
    q: Float[np.ndarray, "T 2"],
    control: Float[np.ndarray, " N"],
    *,
    limit: float,
    arm: float,
    pole: float,
    title: str = "",
) -> None:
    """A film of one run, at the speed of life: the plant, and its control as a bar within its limits.

    Args:
        path: of the GIF.
        kind: "cart-pole" or "rotary-pendulum".
        t: s, at equal steps.
        q: driven coordinate and angle from upright.
        control: N or N m, at all times but the last.
        limit: of it.
        arm: length of the rotary pendulum's arm, m.
        pole: that of the pole, m.
        title: above the time.

    Raises:
        InputError: another kind of plant, or a file that cannot be written.
    """
    drawings = {"cart-pole": _cart_pole, "rotary-pendulum": _rotary_pendulum}
    if kind not in drawings:
        raise InputError(f"a film of {kind!r:.40} is unknown; choose from {', '.join(drawings)}")
    figure = style.blank(height=3.6, width=4.2, dpi=DPI)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[6, 1])[:, 0]
    show_plant = drawings[kind](above, q, arm, pole, max(1, round(TAIL / (t[1] - t[0]))))
    bar = below.subplots()
    style.prepare(bar)
    bar.grid(False)
    bar.set(xlim=(-1, 1), ylim=(-0.5, 0.5), yticks=[], xticks=[-1, 0, 1])
    bar.set_xticklabels(["-limit", "control", "limit"])
    (drawn,) = bar.barh([0.0], [0.0], height=0.7, color=style.VERMILLION)
    stride = max(1, round(1 / (FRAMES_PER_SECOND * (t[1] - t[0]))))

    def show(frame: int) -> None:
        show_plant(frame)
        drawn.set_width(control[min(frame, len(control) - 1)] / limit)

    write_gif(path, figure, show, t, frames=range(0, len(t), stride), frames_per_second=FRAMES_PER_SECOND, title=title)


def _cart_pole(figure: Any, q: np.ndarray, arm: float, pole: float, tail: int) -> Callable[[int], None]:
    axis = figure.subplots()
    room = max(0.6, float(np.abs(q[:, 0]).max()) + 0.15)
    axis.set(xlim=(-room, room), ylim=(-1.35 * pole, 1.35 * pole), aspect="equal", xticks=[], yticks=[])
    for spine in axis.spines.values():
        spine.set_visible(False)
    axis.axhline(-0.025, color="0.75", linewidth=2.0, zorder=0)
    (path,) = axis.plot([], [], color=style.ORANGE, linewidth=1.2, alpha=0.7)
    (cart,) = axis.plot([], [], "s", color=style.BLUE, markersize=16)
    (rod,) = axis.plot([], [], color="0.25", linewidth=3.0, solid_capstyle="round")
    (bob,) = axis.plot([], [], "o", color=style.VERMILLION, markersize=10)
    tip = np.stack([q[:, 0] + pole * np.sin(q[:, 1]), pole * np.cos(q[:, 1])], axis=1)

    def show(frame: int) -> None:
        x, (right, up) = q[frame, 0], tip[frame]
        since = max(0, frame - tail)
        path.set_data(tip[since : frame + 1, 0], tip[since : frame + 1, 1])
        cart.set_data([x], [0.0])
        rod.set_data([x, right], [0.0, up])
        bob.set_data([right], [up])

    return show


def _rotary_pendulum(figure: Any, q: np.ndarray, arm: float, pole: float, tail: int) -> Callable[[int], None]:
    axis = figure.add_subplot(projection="3d")
    size = arm + 0.2 * pole
    axis.set(xlim=(-size, size), ylim=(-size, size), zlim=(-1.05 * pole, 1.05 * pole))
    axis.set_box_aspect((2 * size, 2 * size, 2.1 * pole), zoom=1.35)
    axis.set_axis_off()
    axis.view_init(elev=18, azim=-60)
    around = np.linspace(0, 2 * np.pi, 73)
    axis.plot(arm * np.cos(around), arm * np.sin(around), 0 * around, color="0.8", linewidth=1.0)
    axis.plot([0, 0], [0, 0], [-1.05 * pole, 0], color="0.6", linewidth=5.0)
    elbow, tip = rotary_places(q, arm, pole)
    (path,) = axis.plot([], [], [], color=style.ORANGE, linewidth=1.2, alpha=0.7)
    (shaft,) = axis.plot([], [], [], color=style.BLUE, linewidth=4.0)
    (rod,) = axis.plot([], [], [], color="0.25", linewidth=3.0)
    (bob,) = axis.plot([], [], [], "o", color=style.VERMILLION, markersize=8)

    def show(frame: int) -> None:
        since = max(0, frame - tail)
        path.set_data_3d(*tip[since : frame + 1].T)
        shaft.set_data_3d(*np.stack([np.zeros(3), elbow[frame]]).T)
        rod.set_data_3d(*np.stack([elbow[frame], tip[frame]]).T)
        bob.set_data_3d(*tip[frame][:, None])

    return show


def rotary_places(
    q: Float[np.ndarray, "N 2"], arm: float, pole: float
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Where the arm ends, and the pole, m; the pole swings at right angles to the arm, and q = 0 is upright."""
    along = np.stack([np.cos(q[:, 0]), np.sin(q[:, 0]), np.zeros(len(q))], axis=1)
    across = np.stack([-np.sin(q[:, 0]), np.cos(q[:, 0]), np.zeros(len(q))], axis=1)
    elbow = arm * along
    lifted = np.cos(q[:, 1])[:, None] * np.array([0.0, 0.0, 1.0])
    return elbow, elbow + pole * (np.sin(q[:, 1])[:, None] * across + lifted)
