"""Figures of motions in phase space: predictions over the truth, and their energy."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.style import TRUTH
from dln_jax.metrics.frames import Injection
from dln_jax.metrics.phase_space import Motions
from dln_jax.scenes.datasets.pendulum_frames import FRAME_TIME
from dln_jax.types import require_positive

Field = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(q [N, 1], p [N, 1]) -> (qd, pd)."""
ROOM = 0.15
"""Smallest margin of an axis above and below the truth, relative to the largest true value."""
LEAST = 1e-17
"""Relative errors below this are drawn at this value."""


def motion_figure(
    motions: Mapping[str, Motions],
    energies: Mapping[str, Float[np.ndarray, "K T"]],
    *,
    fields: Mapping[str, Field] | None = None,
    quantity: str = "true energy",
    units: tuple[str, str, str] = ("", "", ""),
    shown: int = 0,
) -> Figure:
    """One motion as predicted by every model, over the truth, with its energy or another quantity over time below.

    With one coordinate a panel is the phase plane, with arrows if `fields` give the rates; with 2 n coordinates it
    shows the orbits of n bodies in a plane. The quantity is drawn beside its error relative to the largest true value.

    Among the motions, "truth" is drawn behind every other one. `energies` holds the `quantity` along the motions;
    `units` are those of q, of p and of the quantity, empty for none.
    """
    models = [name for name in motions if name != TRUTH]
    truth, plane = plane_paths(motions[TRUTH], shown), motions[TRUTH].q.shape[2] == 1
    figure = style.blank(height=2.1 + 7.0 / max(len(models), 3))
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[6.6 / max(len(models), 3), 2.1])[:, 0]
    panels = above.subplots(1, len(models), sharex=True, sharey=True, squeeze=False)[0]
    corner = 1.25 * max(float(np.abs(path).max()) for path in truth)
    for axis, name in zip(panels, models, strict=True):
        style.prepare(axis)
        for x, y in truth:
            axis.plot(x, y, color="black", linewidth=2.2)
        for x, y in plane_paths(motions[name], shown):
            axis.plot(x, y, color=style.colour(name), linewidth=1.2)
        if plane and fields is not None and name in fields:
            _arrows(axis, fields[name], corner)
        axis.set(xlim=(-corner, corner), ylim=(-corner, corner), aspect="equal")
        style.title(axis, name, color=style.colour(name))
        axis.set_xlabel(style.with_unit("q", units[0]) if plane else "x, m")
    panels[0].set_ylabel(style.with_unit("p", units[1]) if plane else "y, m")
    of_shown = {name: np.where(np.isfinite(each[shown]), each[shown], np.nan) for name, each in energies.items()}
    labels = style.with_unit(quantity, units[2]), "error / largest true value"
    for axis, draw, label in zip(below.subplots(1, 2), (_over_time, _relative_errors), labels, strict=True):
        style.prepare(axis)
        draw(axis, motions[TRUTH].t, of_shown)
        axis.set(xlabel="t, s", ylabel=label)
    return figure


def _over_time(axis: Axes, t: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    """The truth is dashed in front of the models; a diverging model leaves the panel."""
    for name, each in values.items():
        dash, order = ("--", 3) if name == TRUTH else ("-", 2)
        axis.plot(t, each, dash, color=style.colour(name), linewidth=1.4, zorder=order, label=name)
    truth, every = values[TRUTH], np.concatenate(list(values.values()))
    low, high = np.nanquantile(every, [0.03, 0.97])
    room = ROOM * float(np.abs(truth).max())
    axis.set_ylim(min(low, truth.min()) - room, max(high, truth.max()) + room)
    style.legend(axis, handles=[line for line in axis.get_lines() if line.get_label() == TRUTH], loc="best")


def _relative_errors(axis: Axes, t: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    """Logarithmic, since errors differ by orders of magnitude; exact values are drawn at rounding level."""
    truth = values[TRUTH]
    size = float(np.abs(truth).max()) or 1.0
    relative = {name: np.maximum(abs(each - truth) / size, LEAST) for name, each in values.items() if name != TRUTH}
    for name, each in relative.items():
        axis.plot(t[1:], each[1:], color=style.colour(name), linewidth=1.0)
    axis.set_yscale("log")
    every = np.concatenate([each[1:][np.isfinite(each[1:])] for each in relative.values()])
    high = np.ceil(np.log10(np.quantile(every, 0.99))) if len(every) else 0.0
    low = np.floor(np.log10(np.quantile(every, 0.02))) if len(every) else -1.0
    axis.set_ylim(10.0 ** min(low, high - 2), 10.0**high * 2)


def plane_paths(motions: Motions, shown: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Curves of one motion: (q, p), or (x, y) of every body; gaps for non-finite values."""
    q, p = motions.q[shown], motions.p[shown]
    q, p = (np.where(np.isfinite(each), each, np.nan) for each in (q, p))
    if q.shape[1] == 1:
        return [(q[:, 0], p[:, 0])]
    return [(q[:, 2 * body], q[:, 2 * body + 1]) for body in range(q.shape[1] // 2)]


def _arrows(axis: Axes, field: Field, corner: float) -> None:
    grid = np.linspace(-corner, corner, 11)
    q, p = (each.reshape(-1, 1) for each in np.meshgrid(grid, grid))
    qd, pd = field(q, p)
    axis.quiver(q, p, qd, pd, color="0.7", zorder=0, width=4e-3)


def injection_figure(injection: Injection, *, shown: int = 7) -> Figure:
    """Decoded frames before and after the injection, the latent path, and the energies against time."""
    require_positive(shown=shown)
    total = len(injection.level)
    half = total // 2
    side = round(np.sqrt(injection.pairs.shape[1] // 2))
    figure = style.blank(height=5.0)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.05])[:, 0]
    colours = style.BLUE, style.VERMILLION
    rows = upper.subplots(2, shown, squeeze=False)
    for row, first, colour, name in zip(rows, (0, half), colours, ("before", "after"), strict=True):
        for axis, index in zip(row, np.linspace(first, first + half - 1, shown).astype(int), strict=True):
            axis.imshow(injection.pairs[index, : side * side].reshape(side, side), cmap="gray", vmin=0, vmax=1)
            axis.set(xticks=[], yticks=[])
            time = f"{FRAME_TIME * injection.latent.t[index]:.2f} s"
            style.title(axis, time, fontsize=style.SMALL, color=colour)
        row[0].set_ylabel(name, color=colour, fontsize=style.TEXT)
    plane, levels = lower.subplots(1, 2, width_ratios=[1.0, 1.6])
    joules = levels.twinx()
    for axis in (plane, levels, joules):
        style.prepare(axis)
    q, p = injection.latent.q[0, :, 0], injection.latent.p[0, :, 0]
    t = FRAME_TIME * injection.latent.t
    for part, colour in zip((slice(0, half), slice(half, total)), colours, strict=True):
        plane.plot(q[part], p[part], color=colour, linewidth=1.5)
        levels.plot(t[part], injection.level[part], color=colour, linewidth=5.0, alpha=0.4)
        joules.plot(t[part], injection.physical[part], ":", color="black", linewidth=1.6)
    plane.annotate("", (q[half], p[half]), (q[half - 1], p[half - 1]), arrowprops={"arrowstyle": "->", "lw": 1.6})
    plane.set(xlabel="latent q, 1", ylabel="latent p, 1 per frame")
    style.title(plane, "path in the latent plane")
    levels.set(xlabel="t, s", ylabel="latent H / H at the start, 1")
    style.title(levels, "energy: latent (band), of the frames (dots)")
    joules.set_ylabel("energy of the frames, J")
    joules.grid(False)
    joules.spines["right"].set_visible(True)
    start = injection.physical[:half].mean()
    top = 1.25 * max(float(injection.level.max()), float(injection.physical.max() / start))
    levels.set_ylim(0.0, top)
    joules.set_ylim(0.0, top * start)
    return figure
