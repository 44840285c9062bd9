"""Friction of joints against their rates: curves of laws or fits, with measured points behind."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style

MOST_POINTS = 4000
"""Of a joint that are drawn."""
MOST_COLUMNS = 4


def friction_curves(
    curves: Mapping[str, tuple[Any, Any]],
    *,
    names: Sequence[str] = (),
    measured: tuple[Any, Any] | None = None,
    rate_unit: str = "rad/s",
    force_unit: str = "N m",
) -> Figure:
    """A panel for each joint.

    Args:
        curves: by name, rates [N, d] of joints, in any order, and forces [N, d].
        names: of the joints; by default their numbers.
        measured: rates and forces [N, d], such as torque less that of the links, drawn as points.
        rate_unit: of all.
        force_unit: of all.
    """
    arrays = {name: tuple(np.atleast_2d(np.asarray(each, float)) for each in pair) for name, pair in curves.items()}
    d = next(iter(arrays.values()))[0].shape[1]
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
            axis.plot(rates[every], forces[every], ".", color=style.REFERENCE, markersize=1.5, rasterized=True)
        for place, (name, (rates, forces)) in enumerate(arrays.items()):
            order = np.argsort(rates[:, joint])
            colour = style.CYCLE[place % len(style.CYCLE)]
            axis.plot(rates[order, joint], forces[order, joint], color=colour, linewidth=1.3, label=name)
        axis.axhline(0, color="black", linewidth=0.5)
        if d > 1:
            style.title(axis, names[joint] if names else f"joint {joint + 1}")
        if joint >= d - columns:
            axis.set_xlabel(f"rate, {rate_unit}")
        if joint % columns == 0:
            axis.set_ylabel(f"friction, {force_unit}")
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=min(len(arrays), 4))
    return figure
