"""Ways of learning side by side: how many environment steps and seconds they need for a distance, and one figure."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from dln_jax.figures import style
from dln_jax.locomotion.learning import Record

Curves = Mapping[str, Sequence[Sequence[Record]]]
"""Records of each seed, by the name of the way of learning."""

COLOURS = {"gradient": style.BLUE, "evolution": style.GREEN, "ppo": style.ORANGE}


def first_reaching(records: Sequence[Record], distance: float) -> Record | None:
    """The first evaluation of a seed that went so far; `None` where none did."""
    return next((record for record in records if record.distance >= distance), None)


def median_to_reach(seeds: Sequence[Sequence[Record]], distance: float, field: str) -> float:
    """Median over seeds of the "steps" or "seconds" needed; infinite where at least half of them never got there."""
    found = [first_reaching(records, distance) for records in seeds]
    return float(np.median([math.inf if record is None else getattr(record, field) for record in found]))


def farthest_so_far(records: Sequence[Record]) -> Float[np.ndarray, " r"]:
    """The best distance up to each evaluation, 0 at least."""
    return np.maximum.accumulate(
        [max(record.distance, 0.0) if record.distance == record.distance else 0.0 for record in records]
    )


def median_curve(seeds: Sequence[Sequence[Record]], field: str) -> tuple[np.ndarray, np.ndarray]:
    """Median over seeds of the farthest so far, at all their places; a seed that has ended keeps its last."""
    places = np.unique([getattr(record, field) for records in seeds for record in records])
    heights = []
    for records in seeds:
        own = np.array([getattr(record, field) for record in records])
        held = np.concatenate([[0.0], farthest_so_far(records)])
        heights.append(held[np.searchsorted(own, places, side="right")])
    return places, np.median(heights, axis=0)


def crossover(first: Sequence[Sequence[Record]], second: Sequence[Sequence[Record]], field: str) -> float | None:
    """The place after which the first's median stays ahead of the second's; `None` where it always or never is."""
    curves = [median_curve(seeds, field) for seeds in (first, second)]
    places = np.unique(np.concatenate([places for places, _ in curves]))
    heights = [np.concatenate([[0.0], values])[np.searchsorted(own, places, side="right")] for own, values in curves]
    behind = np.flatnonzero(heights[0] < heights[1])
    if len(behind) == 0 or behind[-1] == len(places) - 1:
        return None
    return float(places[behind[-1] + 1])


def comparison_figure(curves: Curves, *, distance: float, title: str) -> Figure:
    """Farthest distance so far against environment steps and against wall seconds: seeds thin, their median thick."""
    figure, [panels] = style.figure(1, 2, height=3.6, sharey=True)
    for axis, field, label in zip(
        panels, ("steps", "seconds"), ("environment steps", "wall time incl. compilation, s"), strict=True
    ):
        _panel(axis, curves, field, distance)
        axis.set(xlabel=label, xscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if field == "seconds" else (1,)))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda place, _: f"{place:,.0f}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    # Room for the legends.
    panels[0].set_ylim(top=1.45 * panels[0].get_ylim()[1])
    panels[0].set_ylabel("distance in one episode, body lengths")
    figure.suptitle(title, fontsize=style.TEXT)
    return figure


def learning_figure(seeds: Sequence[Sequence[Record]], *, method: str) -> Figure:
    """The distance of every evaluation against environment steps, a line for each seed."""
    figure, [[axis]] = style.figure(height=3.4)
    for records in seeds:
        places = [record.steps for record in records]
        distances = [record.distance for record in records]
        axis.plot(places, distances, color=COLOURS.get(method, style.PURPLE), linewidth=1.2, alpha=0.8)
    axis.axhline(1.0, color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xlabel="environment steps", ylabel="distance in one episode, body lengths")
    style.title(axis, f"{method}, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}")
    return figure


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
    others = {name: seeds for name, seeds in curves.items() if name != "gradient"}
    places = [crossover(first, seeds, field) for seeds in others.values()] if first else []
    if known := [place for place in places if place is not None]:
        axis.axvline(max(known), color=COLOURS["gradient"], linewidth=0.9, linestyle=":")
        text = "gradient ahead\nof all from here"
        axis.annotate(
            text, (max(known), 0.7), xycoords=("data", "axes fraction"), fontsize=style.SMALL, color=COLOURS["gradient"]
        )
    heading = {"title": "median to reach the dashed line", "title_fontsize": style.SMALL}
    style.legend(axis, loc="upper left", **heading)
