"""Error against time over a grid of runs: one point per run, medians over seeds, the best by validation ringed."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dln_jax.commands.sweeps.table import COMPARED, PROBLEM, problem_of, shortened, spaced, unfinished
from dln_jax.figures import style

MOST_PANELS = 6
"""Largest number of problems drawn in panels of their own."""
MOST_COLOURS = 8
"""Largest number of colours in the legend."""
RUN: dict[str, Any] = {"markersize": 4, "markeredgewidth": 0, "alpha": 0.45, "zorder": 2}
MEDIAN: dict[str, Any] = {"markersize": 8, "markeredgewidth": 0, "zorder": 3}
BEST: dict[str, Any] = {"markersize": 13, "fillstyle": "none", "zorder": 4}


def sweep_figure(results: Mapping[str, Any], at_once: int | None) -> Figure | None:
    """Draws error against training time, `at_once` jobs at once; `None` if no job has both.

    Each problem has a panel, unless there are many. The first two options that no medians are taken over are shown by
    colours and markers. Runs are faint if there are medians.
    """
    rows, over, names = results["jobs"], results["over"], results["names"]
    shown = [(row["values"], row["metrics"], RUN if over else MEDIAN) for row in rows]
    shown += [(row["values"], row["metrics"], BEST) for row in rows if row["best"]]
    shown += [(group["values"], group["medians"], MEDIAN) for group in results["groups"] if over]
    seconds, error = names["train_seconds"], names["error"]
    points = [(values, numbers.get(seconds), numbers.get(error), size) for values, numbers, size in shown]
    points = [point for point in points if point[1] is not None and point[2] is not None]
    if not points:
        return None
    problems = list(dict.fromkeys(problem_of(row["values"]) for row in rows))
    panels = len(problems) <= MOST_PANELS and len(problems) < len(rows)
    options = [name for name in rows[0]["values"] if name not in (*over, *(PROBLEM if panels else ()))]
    colour, marker = (*options, "", "")[:2]

    def look(values: Mapping[str, str], name: str) -> str:
        return shortened(values.get(name, ""))

    kinds, forms = (list(dict.fromkeys(look(point[0], name) for point in points)) for name in (colour, marker))
    colours = dict(zip(kinds, colormaps["viridis"](np.linspace(0, 0.95, len(kinds))), strict=True))
    markers = {form: style.MARKERS[number % len(style.MARKERS)] for number, form in enumerate(forms)}

    problems = problems if panels else [()]
    columns = min(len(problems), 2)
    lines = -(-len(problems) // columns)
    figure, axes = style.figure(lines, columns, height=2.7 * lines + 1.1 if columns > 1 else 4.0)
    for axis in axes.flat[len(problems) :]:
        axis.axis("off")
    for axis, problem in zip(axes.flat, problems, strict=False):
        here = [point for point in points if not panels or problem_of(point[0]) == problem]
        for values, x, y, size in here:
            if size is BEST:
                axis.plot(x, y, "o", color="black", **size)
            else:
                axis.plot(x, y, markers[look(values, marker)], color=colours[look(values, colour)], **size)
        axis.set_xscale(style.scale_of(x for _, x, _, _ in here))
        axis.set_yscale(style.scale_of(y for _, _, y, _ in here))
        style.title(axis, ", ".join(f"{name} {shortened(text)}" for name, text in problem))
    beside = "" if at_once is None else f", {at_once} jobs at once" if at_once > 1 else ", one job at a time"
    work = seconds.removesuffix("_seconds").replace("train", "training")
    for axis in axes.flat[max(0, len(problems) - columns) : len(problems)]:
        axis.set_xlabel(f"{work}, s{beside}")
    for axis in axes[:, 0]:
        axis.set_ylabel("test " * (error in COMPARED["error"]) + spaced(error))

    def handle(marker: str, label: str, **looks: Any) -> Line2D:
        return Line2D([], [], marker=marker, label=label, **{"linestyle": "", "color": "0.4", **looks})

    handles = []
    if colour:
        for kind in kinds[:: -(-len(kinds) // MOST_COLOURS)]:
            handles.append(handle("s", f"{spaced(colour)} {kind}", color=colours[kind]))
    if marker:
        handles += [handle(markers[form], f"{spaced(marker)} {form}") for form in forms]
    if over:
        handles += [handle("o", "a run", **RUN), handle("o", "median", **MEDIAN)]
    if any(row["best"] for row in rows):
        handles.append(handle("o", "best in validation", **{**BEST, "color": "black", "markersize": 10}))
    if handles or unfinished(rows):
        note = {"title": unfinished(rows) or None, "title_fontsize": style.SMALL}
        style.legend(figure, handles=handles, loc="outside lower center", ncols=4, **note)
    return figure
