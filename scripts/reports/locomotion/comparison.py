"""Methods of learning to move, compared by their cost until a creature travels five body lengths: rows and a figure."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dln_jax.figures import style
from dln_jax.locomotion.learning import Record
from dln_jax.training.locomotion import first_reaching, median_to_reach
from scripts.reports.rows import Row

Curves = Mapping[str, Sequence[Sequence[Record]]]
"""Records of the seeds, by the name of the method."""
COLOURS = {"gradient": style.BLUE, "evolution": style.GREEN, "ppo": style.ORANGE, "sac": style.PURPLE}
BELOW_LEGEND = 0.62
"""Share of a panel's height for the curves, below the legend."""


def farthest_so_far(records: Sequence[Record]) -> Float[np.ndarray, " r"]:
    """The best distance up to every evaluation, at least 0."""
    return np.maximum.accumulate(np.fmax([record.distance for record in records], 0.0))


def median_curve(seeds: Sequence[Sequence[Record]], field: str) -> tuple[np.ndarray, np.ndarray]:
    """Median over seeds of the best distance so far, at all evaluations; a seed that has ended keeps its last value."""
    own = [[getattr(record, field) for record in records] for records in seeds]
    places = np.unique(np.concatenate(own))
    held = [_held(at, farthest_so_far(records), places) for at, records in zip(own, seeds, strict=True)]
    return places, np.median(held, axis=0)


def crossover(first: Sequence[Sequence[Record]], second: Sequence[Sequence[Record]], field: str) -> float | None:
    """Point after which the first method's median stays ahead of the second's; `None` if it always or never is."""
    curves = [median_curve(seeds, field) for seeds in (first, second)]
    places = np.unique(np.concatenate([places for places, _ in curves]))
    behind = np.flatnonzero(_held(*curves[0], places) < _held(*curves[1], places))
    if len(behind) == 0 or behind[-1] == len(places) - 1:
        return None
    return float(places[behind[-1] + 1])


def comparison_rows(creature: str, curves: dict[str, list[list[Record]]], *, goal: float, seed: int) -> list[Row]:
    """Steps and seconds of the methods, and ratios to gradients; only the crawler's numbers have bounds.

    `curves` holds, by method, the records of successive seeds starting at `seed`; `goal` is in body lengths.
    """
    rows, needed, crawls, steps = [], {}, creature == "crawler", "environment_steps_to_five_body_lengths"
    for method, seeds in curves.items():
        case = f"{creature}/{method}"
        for number, records in enumerate(seeds, start=seed):
            first = first_reaching(records, goal)
            rows.append(Row(case, f"{steps}_seed_{number}", math.nan if first is None else float(first.steps)))
        median, seconds = (median_to_reach(seeds, goal, field) for field in ("steps", "seconds"))
        needed[method] = float(max(r[-1].steps for r in seeds)) if math.isinf(median) else median
        bound = 60.0 if method == "gradient" and crawls else None
        rows += [Row(case, steps, median), Row(case, "seconds_to_five_body_lengths", seconds, "s", bound=bound)]
    name, bound = "environment_steps_ratio_to_gradient", 3.0 if crawls else None
    ratios = {method: needed[method] / needed["gradient"] for method in curves if method != "gradient"}
    rows += [Row(f"{creature}/{method}", name, ratio, bound=bound, at_least=True) for method, ratio in ratios.items()]
    return rows


def comparison_figure(curves: Curves, *, distance: float, title: str) -> Figure:
    """Best distance so far against environment steps and against wall seconds: seeds thin, their median thick."""
    figure, [panels] = style.figure(1, 2, height=3.6, sharey=True)
    labels = {"steps": "environment steps", "seconds": "wall time incl. compilation, s"}
    for axis, (field, label) in zip(panels, labels.items(), strict=True):
        _panel(axis, curves, field, distance)
        axis.set(xlabel=label, xscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if field == "seconds" else (1,)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda place, _: f"{place:,.0f}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    panels[0].set_ylim(top=panels[0].get_ylim()[1] / BELOW_LEGEND)
    panels[0].set_ylabel("distance in one episode, body lengths")
    figure.suptitle(title, fontsize=style.TEXT)
    return figure


def _held(own: Any, values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Last value up to every place, 0 before the first."""
    return np.concatenate([[0.0], values])[np.searchsorted(own, places, side="right")]


def _panel(axis: Axes, curves: Curves, field: str, distance: float) -> None:
    axis.axhline(distance, color="0.6", linewidth=0.8, linestyle="--")
    for name, seeds in curves.items():
        colour = COLOURS.get(name, style.PURPLE)
        for records in seeds:
            places = [getattr(record, field) for record in records]
            axis.step(places, farthest_so_far(records), where="post", color=colour, linewidth=0.7, alpha=0.5)
        median = median_to_reach(seeds, distance, field)
        reached = "not reached" if math.isinf(median) else f"{median:,.0f}" + (" s" if field == "seconds" else "")
        axis.step(*median_curve(seeds, field), where="post", color=colour, linewidth=2.4, label=f"{name}: {reached}")
        if not math.isinf(median):
            axis.plot(median, distance, "o", color=colour, markersize=6, zorder=4)
    first = curves.get("gradient")
    places = [crossover(first, seeds, field) for name, seeds in curves.items() if name != "gradient"] if first else []
    if known := [place for place in places if place is not None]:
        look = {"color": COLOURS["gradient"], "linewidth": 1.2, "linestyle": ":"}
        axis.axvline(max(known), ymax=BELOW_LEGEND, label="from here gradient is ahead", **look)
    style.legend(axis, loc="upper left", title="median to reach the dashed line", title_fontsize=style.SMALL)
