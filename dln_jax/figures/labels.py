"""Places labels in a figure without overlap: at the ends of curves, and beside points."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import Bbox, BboxBase

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


class Place(NamedTuple):
    """Position of a label relative to its point."""

    x: int
    """-1, 0 or 1: to the left, above or below, to the right."""
    y: int
    """-1, 0 or 1: below, beside, above."""
    distance: float
    """Distance in points."""

    def box(self, at: np.ndarray, width: float, height: float, pixels: float) -> Bbox:
        """Bounding box of a text of this size, in pixels; `pixels` is the number of pixels per point."""
        left, bottom = at + pixels * self.distance * np.array([self.x, self.y])
        corner = left + (self.x - 1) / 2 * width, bottom + (self.y - 1) / 2 * height
        return Bbox.from_bounds(*corner, width, height)


BESIDE = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Directions in which a label may be placed, the best first."""
NEAR, FAR = 4.0, (12.0, 22.0, 34.0)
"""Distances of a label from its point, in points; a far label gets a connecting line."""


def label_points(
    axis: Axes,
    points: Sequence[tuple[str, tuple[float, float]]],
    *,
    obstacles: np.ndarray,
    first: tuple[int, int] = (1, 0),
    size: float = SMALL,
) -> None:
    """Places (text, (x, y)) labels beside their points, where they cover the fewest obstacles, labels and edges.

    Call it when the figure is complete, since labels take the space that is still free.

    Args:
        axis: axes of the points, which are in data units.
        points: texts and positions.
        obstacles: points [n, 2] that labels should not cover.
        first: preferred direction from a point to its label.
        size: text size in points.
    """
    colour = "0.25"
    drawn = axis.figure.get_figure(root=True)
    drawn.draw_without_rendering()
    pixels = drawn.dpi / 72
    covered, frame, taken = axis.transData.transform(obstacles), axis.get_window_extent(), []
    places = [Place(*way, distance) for distance in (NEAR, *FAR) for way in dict.fromkeys((first, *BESIDE))]
    for text, point in points:
        label = axis.annotate(text, point, (0, 0), textcoords="offset points", fontsize=size, color=colour, zorder=100)
        # Labels must not change the layout, since their positions are computed without them.
        label.set_in_layout(False)
        extent = label.get_window_extent()
        at = axis.transData.transform(point)

        def cost(place: Place, at=at, extent=extent) -> float:
            box = place.box(at, extent.width, extent.height, pixels)
            crowded = sum(_common(box, other) for other in taken) + box.width * box.height - _common(box, frame)
            return box.padded(1.0).count_contains(covered) + 0.05 * crowded + 0.02 * place.distance

        best = min(places, key=cost)
        taken.append(best.box(at, extent.width, extent.height, pixels).padded(2.0))
        label.set(ha=("center", "left", "right")[best.x], va=("center", "bottom", "top")[best.y])
        label.set_position((best.distance * best.x, best.distance * best.y))
        if best.distance > NEAR:
            away = label.xyann
            axis.annotate("", point, away, textcoords="offset points", arrowprops={**LINE, "color": colour}, zorder=99)


def _common(one: BboxBase, other: BboxBase) -> float:
    """Intersection area, square pixels."""
    both = Bbox.intersection(one, other)
    return 0.0 if both is None else both.width * both.height
