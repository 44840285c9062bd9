"""Friction of joints against their rates: fitted curves over measured points."""

import itertools
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
    arrays = {name: (np.asarray(rates), np.asarray(forces)) for name, (rates, forces) in curves.items()}
    d = next(iter(arrays.values()))[0].shape[1]
    rate_units, force_units = np.broadcast_to(rate_unit, d), np.broadcast_to(force_unit, d)
    alike = len({*zip(rate_units, force_units, strict=True)}) == 1
    columns = min(d, MOST_COLUMNS)
    rows = -(-d // columns)
    figure, axes = style.figure(rows, columns, height=0.6 + 2.4 * rows)
    for axis in axes.flat[d:]:
        axis.set_visible(False)
    for joint, axis in enumerate(axes.flat[:d]):
        if measured is not None:
            rates, forces = (np.asarray(values)[:, joint] for values in measured)
            every = slice(None, None, -(-len(rates) // MOST_POINTS))
            points = {"color": style.REFERENCE, "markersize": 1.5, "rasterized": True, "label": "measured"}
            axis.plot(rates[every], forces[every], ".", **points)
            seen = [np.percentile(forces, [0.5, 99.5]), *(forces[:, joint] for _, forces in arrays.values())]
            low, high = float(min(map(np.min, seen))), float(max(map(np.max, seen)))
            room = 0.1 * (high - low) or 1.0
            axis.set_ylim(low - room, high + room)
        for colour, (name, (rates, forces)) in zip(itertools.cycle(style.CYCLE), arrays.items(), strict=False):
            order = np.argsort(rates[:, joint])
            axis.plot(rates[order, joint], forces[order, joint], color=colour, linewidth=1.3, label=name)
        axis.axhline(0, color="black", linewidth=0.5)
        axis.locator_params(axis="x", nbins=5)
        if d > 1:
            style.title(axis, names[joint] if names else f"joint {joint + 1}")
        if joint >= d - columns or not alike:
            axis.set_xlabel(f"rate, {rate_units[joint]}")
        if joint % columns == 0 or not alike:
            axis.set_ylabel(f"friction, {force_units[joint]}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    style.legend(figure, handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure
