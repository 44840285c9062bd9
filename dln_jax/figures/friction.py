"""Friction of joints against their rates: fitted curves over measured points."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style

MOST_POINTS = 4000
"""Largest number of points drawn per joint."""
MOST_COLUMNS = 4


def friction_curves(
    curves: Mapping[str, tuple[Any, Any]],
    *,
    names: Sequence[str] = (),
    measured: tuple[Any, Any] | None = None,
    rate_unit: str | Sequence[str] = "rad/s",
    force_unit: str | Sequence[str] = "N m",
) -> Figure:
    """Friction curves, one panel per joint.

    Args:
        curves: by name, rates [N, d] of the joints, in any order, and forces [N, d].
        names: names of the joints; by default their numbers.
        measured: rates and forces [N, d], such as torque minus that of the links, drawn as points; the most extreme
            hundredth may lie out of view.
        rate_unit: one unit for all joints, or one each.
        force_unit: likewise.
    """
    arrays = {name: tuple(np.atleast_2d(np.asarray(each, float)) for each in pair) for name, pair in curves.items()}
    d = next(iter(arrays.values()))[0].shape[1]
    units = [(rate_unit, force_unit)] * d
    if not (isinstance(rate_unit, str) and isinstance(force_unit, str)):
        units = list(zip(np.broadcast_to(rate_unit, d), np.broadcast_to(force_unit, d), strict=True))
    alike = len(set(units)) == 1
    columns = min(d, MOST_COLUMNS)
    rows = -(-d // columns)
    figure, axes = style.figure(rows, columns, height=0.6 + 2.4 * rows)
    for joint, axis in enumerate(axes.flat):
        if joint >= d:
            axis.set_visible(False)
            continue
        if measured is not None:
            rates, forces = (np.asarray(each)[:, joint] for each in measured)
            every = slice(None, None, -(-len(rates) // MOST_POINTS))
            points = {"color": style.REFERENCE, "markersize": 1.5, "rasterized": True, "label": "measured"}
            axis.plot(rates[every], forces[every], ".", **points)
            seen = [np.percentile(forces, [0.5, 99.5]), *(curve[:, joint] for _, curve in arrays.values())]
            axis.set_ylim(*_with_room(np.concatenate(seen)))
        for place, (name, (rates, forces)) in enumerate(arrays.items()):
            order = np.argsort(rates[:, joint])
            colour = style.CYCLE[place % len(style.CYCLE)]
            axis.plot(rates[order, joint], forces[order, joint], color=colour, linewidth=1.3, label=name)
        axis.axhline(0, color="black", linewidth=0.5)
        axis.locator_params(axis="x", nbins=5)
        if d > 1:
            style.title(axis, names[joint] if names else f"joint {joint + 1}")
        of_rates, of_forces = units[joint]
        if joint >= d - columns or not alike:
            axis.set_xlabel(f"rate, {of_rates}")
        if joint % columns == 0 or not alike:
            axis.set_ylabel(f"friction, {of_forces}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    style.legend(figure, handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure


def _with_room(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    room = 0.1 * (high - low) or 1.0
    return low - room, high + room
