"""Labels at the ends of curves, moved apart where they would overlap."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from dln_jax.figures.style import SMALL

LINE = {"arrowstyle": "-", "linewidth": 0.5, "shrinkB": 3}
"""Style of the line from a label to its point."""


def label_ends(axis: Axes, ends: Mapping[str, tuple[float, float]], *, colours: Mapping[str, str]) -> None:
    """Labels curves at the right edge, at the height of their ends (x, y), moved apart if they would overlap.

    A curve with a non-finite end is labelled as such at the top. Call it after the axis limits and the figure size are
    final.
    """
    drawn = axis.figure.get_figure(root=True)
    fractions = axis.transData + axis.transAxes.inverted()
    lost = [name for name, end in ends.items() if not np.isfinite(end).all()]
    heights = {
        name: 1.0 if name in lost else float(np.clip(fractions.transform(end)[1], 0.0, 1.0))
        for name, end in ends.items()
    }
    share = axis.get_position().height * drawn.get_figheight()
    places = spread(heights, gap=1.25 * SMALL / 72 / share)
    for name, place in places.items():
        axis.annotate(
            f"{name}: not finite" if name in lost else name,
            (1.0, place) if name in lost else ends[name],
            (1.03, place),
            xycoords="axes fraction" if name in lost else "data",
            textcoords="axes fraction",
            annotation_clip=False,
            va="center",
            fontsize=SMALL,
            color=colours[name],
            arrowprops=None if name in lost else {**LINE, "relpos": (0, 0.5), "color": colours[name], "alpha": 0.6},
        )


def spread(heights: Mapping[str, float], *, gap: float) -> dict[str, float]:
    """Moves heights by the least amount that leaves a gap between neighbours, keeping their order and within [0, 1]."""
    names = sorted(heights, key=lambda name: heights[name])
    gap = min(gap, 1.0 / max(len(names) - 1, 1))
    # After k gaps are subtracted from the k-th height, the order only requires nondecreasing values: isotonic
    # regression.
    blocks: list[tuple[float, int]] = []
    for rung, name in enumerate(names):
        blocks.append((heights[name] - rung * gap, 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (below, many), (above, more) = blocks[-2:]
            blocks[-2:] = [((below * many + above * more) / (many + more), many + more)]
    top = 1.0 - gap * (len(names) - 1)
    flat = [float(np.clip(height, 0.0, top)) for height, count in blocks for _ in range(count)]
    return {name: height + rung * gap for rung, (name, height) in enumerate(zip(names, flat, strict=True))}
