"""Error against time over a grid of runs: one point per run, medians over seeds, the best by validation ringed."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dln_jax.figures import style

MOST_COLOURS = len(style.CYCLE)


class Point(NamedTuple):
    """A run, or the median of several runs."""

    seconds: float
    error: float
    colour: str = ""
    """Value of the option shown by colours."""
    marker: str = ""
    """Value of the option shown by markers."""
    problem: str = ""
    """Title of the panel that shows it."""
    median: bool = False
    best: bool = False


def error_against_seconds(
    points: Sequence[Point], *, x: str, y: str, colour: str = "", marker: str = "", note: str = ""
) -> Figure:
    """Error against time, one panel per problem; runs are faint if there are medians.

    Args:
        x, y: labels of the axes.
        colour, marker: names of the options that they show, or empty; the legend lists up to `MOST_COLOURS` colours.
        note: text below the axes, for example about missing runs.
    """
    problems = list(dict.fromkeys(point.problem for point in points))
    columns = min(len(problems), 2)
    rows = -(-len(problems) // columns)
    figure, axes = style.figure(rows, columns, height=2.7 * rows + 1.1 if columns > 1 else 4.0)
    colours = _colours(list(dict.fromkeys(point.colour for point in points)))
    values = list(dict.fromkeys(point.marker for point in points))
    markers = {value: style.MARKERS[number % len(style.MARKERS)] for number, value in enumerate(values)}
    medians = any(point.median for point in points)
    for number, (axis, problem) in enumerate(zip(axes.flat, problems, strict=False)):
        here = [point for point in points if point.problem == problem]
        for point in here:
            faint = medians and not point.median
            looks = {"markersize": 4, "alpha": 0.45, "zorder": 2} if faint else {"markersize": 8, "zorder": 3}
            colour_here = {"color": colours[point.colour], "markeredgewidth": 0}
            axis.plot(point.seconds, point.error, markers[point.marker], **looks, **colour_here)
            if point.best:
                axis.plot(point.seconds, point.error, "o", markersize=13, color="black", fillstyle="none", zorder=4)
        axis.set_xscale(style.scale_of(point.seconds for point in here))
        axis.set_yscale(style.scale_of(point.error for point in here))
        style.title(axis, problem)
        if number >= len(problems) - columns:
            axis.set_xlabel(x)
        if number % columns == 0:
            axis.set_ylabel(y)
    for axis in list(axes.flat)[len(problems) :]:
        axis.axis("off")
    handles = []
    if colour:
        listed = list(colours)[:: -(-len(colours) // MOST_COLOURS)]
        handles += [Line2D([], [], color=colours[value], linewidth=5, label=f"{colour} {value}") for value in listed]
    if marker:
        handles += [_handle(markers[value], f"{marker} {value}") for value in markers]
    if medians:
        handles += [_handle("o", "a run", markersize=4), _handle("o", "median", markersize=8)]
    if any(point.best for point in points):
        handles.append(_handle("o", "best in validation", color="black", fillstyle="none", markersize=10))
    if handles or note:
        titled = {"title": note, "title_fontsize": style.SMALL} if note else {}
        style.legend(figure, handles=handles, loc="outside lower center", ncols=4, **titled)
    return figure


def _handle(marker: str, label: str, **looks: Any) -> Line2D:
    return Line2D([], [], linestyle="", marker=marker, label=label, **{"color": "0.4", **looks})


def _colours(values: Sequence[str]) -> dict[str, Any]:
    """Returns colours in sequence, or along a colour map if there are more values than colours."""
    if len(values) <= MOST_COLOURS:
        return style.colours_of(values)
    return dict(zip(values, map(tuple, colormaps["viridis"](np.linspace(0, 0.95, len(values)))), strict=True))
