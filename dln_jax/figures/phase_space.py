"""Figures and films of motions in phase space: predictions over the truth, and their energy."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.style import TRUTH
from dln_jax.metrics.phase_space import Motions
from dln_jax.types import InputError, require_positive

Field = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(q [N, 1], p [N, 1]) -> (qd, pd)."""
ROOM = 0.15
"""Smallest margin of an axis above and below the truth, relative to the largest true value."""
ROUNDING = 1e-17
"""Relative errors below this value are drawn at it."""


def motion_figure(
    motions: Mapping[str, Motions],
    energies: Mapping[str, Float[np.ndarray, "K T"]],
    *,
    fields: Mapping[str, Field] | None = None,
    quantity: str = "true energy",
    units: tuple[str, str, str] = ("", "", ""),
) -> Figure:
    """The first motion by every model, over the truth, with its energy or another quantity over time below.

    With one coordinate a panel is the phase plane, with arrows if `fields` give the rates; with 2 n coordinates it
    shows the orbits of n bodies in a plane. The quantity is drawn beside its error relative to the largest true value.

    The motion "truth" is drawn behind the others. `energies` holds the `quantity` along the motions; `units` are those
    of q, of p and of the quantity, empty for none.
    """
    models = [name for name in motions if name != TRUTH]
    truth, plane = plane_paths(motions[TRUTH]), motions[TRUTH].q.shape[2] == 1
    figure = style.blank(height=2.1 + 7.0 / max(len(models), 3))
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[6.6 / max(len(models), 3), 2.1])[:, 0]
    panels = above.subplots(1, len(models), sharex=True, sharey=True, squeeze=False)[0]
    over_time, errors = below.subplots(1, 2)
    style.prepare(*panels, over_time, errors)
    corner = 1.25 * max(float(np.abs(path).max()) for path in truth)
    for axis, name in zip(panels, models, strict=True):
        for x, y in truth:
            axis.plot(x, y, color="black", linewidth=2.2)
        for x, y in plane_paths(motions[name]):
            axis.plot(x, y, color=style.colour(name), linewidth=1.2)
        if plane and fields is not None and name in fields:
            grid = np.linspace(-corner, corner, 11)
            states = [values.reshape(-1, 1) for values in np.meshgrid(grid, grid)]
            axis.quiver(*states, *fields[name](*states), color="0.7", zorder=0, width=4e-3)
        axis.set(xlim=(-corner, corner), ylim=(-corner, corner), aspect="equal")
        style.title(axis, name, color=style.colour(name))
    _label(panels, plane, *units[:2])
    t = motions[TRUTH].t
    values = {name: np.where(np.isfinite(energy[0]), energy[0], np.nan) for name, energy in energies.items()}
    true = values[TRUTH]
    largest, finite = float(np.abs(true).max()), []
    for name, energy in values.items():
        # The truth is dashed in front of the models; a diverging model leaves the panel.
        dash, order = ("--", 3) if name == TRUTH else ("-", 2)
        over_time.plot(t, energy, dash, color=style.colour(name), linewidth=1.4, zorder=order, label=name)
        if name != TRUTH:
            # Errors differ by orders of magnitude; exact values are drawn at rounding level.
            error = np.maximum(abs(energy - true) / (largest or 1.0), ROUNDING)[1:]
            errors.plot(t[1:], error, color=style.colour(name), linewidth=1.0)
            finite += error[np.isfinite(error)].tolist()
    low, high = np.nanquantile(np.concatenate(list(values.values())), [0.03, 0.97])
    over_time.set_ylim(min(low, true.min()) - ROOM * largest, max(high, true.max()) + ROOM * largest)
    style.legend(over_time, handles=[line for line in over_time.get_lines() if line.get_label() == TRUTH], loc="best")
    low, high = np.log10(np.quantile(finite or [0.1, 1.0], [0.02, 0.99]))
    errors.set_yscale("log")
    errors.set_ylim(10.0 ** min(np.floor(low), np.ceil(high) - 2), 2 * 10.0 ** np.ceil(high))
    over_time.set(xlabel="t, s", ylabel=style.with_unit(quantity, units[2]))
    errors.set(xlabel="t, s", ylabel="error / largest true value")
    return figure


def _label(panels: np.ndarray, plane: bool, unit: str, momentum: str) -> None:
    for axis in panels:
        axis.set_xlabel(style.with_unit("q", unit) if plane else "x, m")
    panels[0].set_ylabel(style.with_unit("p", momentum) if plane else "y, m")


def plane_paths(motions: Motions) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the curves of the first motion: (q, p), or (x, y) of every body; gaps for non-finite values."""
    q, p = motions.q[0], motions.p[0]
    q, p = (np.where(np.isfinite(state), state, np.nan) for state in (q, p))
    if q.shape[1] == 1:
        return [(q[:, 0], p[:, 0])]
    return [(q[:, 2 * body], q[:, 2 * body + 1]) for body in range(q.shape[1] // 2)]


def write_motion_gif(
    path: Path,
    motions: Mapping[str, Motions],
    *,
    tail: int = 20,
    stride: int = 1,
    units: tuple[str, str] = ("", ""),
    frames_per_second: float = 20.0,
) -> None:
    """Writes a GIF with the first motion of every system in its own panel, over the truth in black if there is one.

    With one coordinate a panel is the phase plane; with 2 n coordinates it shows n bodies in a plane.

    `tail` is the number of samples in the trace behind a body, `stride` the number of samples between two frames;
    `units` are those of one coordinate of q and of p, empty for none.

    Raises:
        InputError: there is no motion, or motions have different lengths.
    """
    require_positive(tail=tail, stride=stride, frames_per_second=frames_per_second)
    lengths = {name: moved.q.shape[1] for name, moved in motions.items()}
    if not motions or len({*lengths.values()}) > 1 or 0 in lengths.values():
        raise InputError(f"the motions to show have these numbers of samples: {lengths}; expected one number, above 0")
    first = next(iter(motions.values()))
    t, plane = first.t, first.q.shape[2] == 1
    curves = {name: plane_paths(moved) for name, moved in motions.items()}
    framed = curves.get(TRUTH) or [curve for paths in curves.values() for curve in paths]
    corners = 1.2 * np.nanmax(np.abs(framed), axis=(0, 2))
    if not plane:
        corners[:] = corners.max()
    models = [name for name in motions if name != TRUTH] or [TRUTH]
    width = min(style.WIDTH, 3.4 * len(models))
    figure, axes = style.figure(
        1, len(models), width=width, height=width / len(models) + 0.6, sharey=True, dpi=style.FILM_DPI
    )
    lines = []
    for axis, name in zip(axes[0], models, strict=True):
        axis.set(xlim=(-corners[0], corners[0]), ylim=(-corners[1], corners[1]), box_aspect=1)
        over = TRUTH in motions and name != TRUTH
        style.title(axis, f"{name}, over the truth" if over else name, color=style.colour(name))
        for system in (TRUTH, name) if over else (name,):
            width, size = (3.0, 8) if system == TRUTH else (1.4, 5)
            for curve in curves[system]:
                (line,) = axis.plot([], [], color=style.colour(system), linewidth=width)
                (body,) = axis.plot([], [], "o", color=style.colour(system), markersize=size)
                lines.append((line, body, curve))
    _label(axes[0], plane, *units)

    def show(index: int) -> None:
        for line, body, (x, y) in lines:
            for artist, first in ((line, max(0, index - tail)), (body, index)):
                artist.set_data(x[first : index + 1], y[first : index + 1])

    style.write_gif(path, figure, show, t, frames=range(0, len(t), stride), frames_per_second=frames_per_second)
