"""Figures of motions in phase space: predictions over the truth, and their energy."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.style import TRUTH
from dln_jax.metrics.phase_space import Motions

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
    shown: int = 0,
) -> Figure:
    """One motion as predicted by every model, over the truth, with its energy or another quantity over time below.

    With one coordinate a panel is the phase plane, with arrows if `fields` give the rates; with 2 n coordinates it
    shows the orbits of n bodies in a plane. The quantity is drawn beside its error relative to the largest true value.

    The motion "truth" is drawn behind the others. `energies` holds the `quantity` along the motions; `units` are those
    of q, of p and of the quantity, empty for none.
    """
    models = [name for name in motions if name != TRUTH]
    truth, plane = plane_paths(motions[TRUTH], shown), motions[TRUTH].q.shape[2] == 1
    figure = style.blank(height=2.1 + 7.0 / max(len(models), 3))
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[6.6 / max(len(models), 3), 2.1])[:, 0]
    panels = above.subplots(1, len(models), sharex=True, sharey=True, squeeze=False)[0]
    over_time, errors = below.subplots(1, 2)
    style.prepare(*panels, over_time, errors)
    corner = 1.25 * max(float(np.abs(path).max()) for path in truth)
    for axis, name in zip(panels, models, strict=True):
        for x, y in truth:
            axis.plot(x, y, color="black", linewidth=2.2)
        for x, y in plane_paths(motions[name], shown):
            axis.plot(x, y, color=style.colour(name), linewidth=1.2)
        if plane and fields is not None and name in fields:
            grid = np.linspace(-corner, corner, 11)
            states = [values.reshape(-1, 1) for values in np.meshgrid(grid, grid)]
            axis.quiver(*states, *fields[name](*states), color="0.7", zorder=0, width=4e-3)
        axis.set(xlim=(-corner, corner), ylim=(-corner, corner), aspect="equal")
        style.title(axis, name, color=style.colour(name))
        axis.set_xlabel(style.with_unit("q", units[0]) if plane else "x, m")
    panels[0].set_ylabel(style.with_unit("p", units[1]) if plane else "y, m")
    t = motions[TRUTH].t
    values = {name: np.where(np.isfinite(energy[shown]), energy[shown], np.nan) for name, energy in energies.items()}
    _draw_over_time(over_time, t, values)
    _draw_errors(errors, t, values)
    for axis, label in ((over_time, style.with_unit(quantity, units[2])), (errors, "error / largest true value")):
        axis.set(xlabel="t, s", ylabel=label)
    return figure


def _draw_over_time(axis: Axes, t: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    """Draws the truth dashed in front of the models; a diverging model leaves the panel."""
    for name, energy in values.items():
        dash, order = ("--", 3) if name == TRUTH else ("-", 2)
        axis.plot(t, energy, dash, color=style.colour(name), linewidth=1.4, zorder=order, label=name)
    truth = values[TRUTH]
    low, high = np.nanquantile(np.concatenate(list(values.values())), [0.03, 0.97])
    room = ROOM * float(np.abs(truth).max())
    axis.set_ylim(min(low, truth.min()) - room, max(high, truth.max()) + room)
    style.legend(axis, handles=[line for line in axis.get_lines() if line.get_label() == TRUTH], loc="best")


def _draw_errors(axis: Axes, t: np.ndarray, values: Mapping[str, np.ndarray]) -> None:
    """Draws errors logarithmically, since they differ by orders of magnitude; exact values are at rounding level."""
    truth, finite = values[TRUTH], []
    size = float(np.abs(truth).max()) or 1.0
    for name, energy in values.items():
        if name != TRUTH:
            error = np.maximum(abs(energy - truth) / size, ROUNDING)[1:]
            axis.plot(t[1:], error, color=style.colour(name), linewidth=1.0)
            finite += error[np.isfinite(error)].tolist()
    axis.set_yscale("log")
    low, high = np.log10(np.quantile(finite or [0.1, 1.0], [0.02, 0.99]))
    axis.set_ylim(10.0 ** min(np.floor(low), np.ceil(high) - 2), 2 * 10.0 ** np.ceil(high))


def plane_paths(motions: Motions, shown: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the curves of one motion: (q, p), or (x, y) of every body; gaps for non-finite values."""
    q, p = motions.q[shown], motions.p[shown]
    q, p = (np.where(np.isfinite(state), state, np.nan) for state in (q, p))
    if q.shape[1] == 1:
        return [(q[:, 0], p[:, 0])]
    return [(q[:, 2 * body], q[:, 2 * body + 1]) for body in range(q.shape[1] // 2)]
