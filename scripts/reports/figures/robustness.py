"""Shares of successes by disturbance, as a map of numbers."""

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from dln_jax.figures import style

COLOURS = LinearSegmentedColormap.from_list("shares", ["#ffffff", "#9ecae1", style.BLUE])


def shares(tables: Mapping[str, Mapping[str, Mapping[str, float]]], *, ours: str = "ours") -> Figure:
    """Shares [0, 1] by controller and criterion, one panel per plant; darker is better.

    Args:
        tables: shares by plant, controller and criterion; the criteria are the same in all tables.
        ours: prefix of the names of our controllers, which a line separates from the others.
    """
    heights = [len(table) for table in tables.values()]
    figure, axes = style.figure(
        len(tables), 1, height=0.9 + 0.36 * sum(heights), gridspec_kw={"height_ratios": heights}, sharex=True
    )
    for axis, (plant, table) in zip(axes[:, 0], tables.items(), strict=True):
        criteria = list(next(iter(table.values())))
        values = np.array([[row[key] for key in criteria] for row in table.values()])
        axis.grid(False)
        axis.imshow(values, cmap=COLOURS, vmin=0, vmax=1, aspect="auto")
        for (row, column), value in np.ndenumerate(values):
            shade = "white" if value > 0.7 else "black"
            weight = "bold" if criteria[column] == "mean" else "normal"
            axis.text(
                column, row, f"{100 * value:.0f}", ha="center", va="center", color=shade, weight=weight,
                fontsize=style.SMALL,
            )  # fmt: skip
        own = sum(name.startswith(ours) for name in table)
        axis.axhline(own - 0.5, color="black", linewidth=1.0)
        axis.set_yticks(
            range(len(table)), [name.replace("-", " ") if name.startswith(ours) else name for name in table]
        )
        axis.set_xticks(range(len(criteria)), [key.replace("_", " ") for key in criteria])
        axis.tick_params(length=0)
        axis.set_title(f"{plant}: successes, %", loc="left", fontsize=style.TEXT)
        for spine in axis.spines.values():
            spine.set_visible(False)
    return figure
