"""Figures of benchmarks: growing costs as lines, and speed against error as points with their Pareto front."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

MARKERS = "osv^Ddp*"


def curves(lines: Mapping[str, tuple[Sequence[float], Sequence[float]]], *, x: str, y: str, title: str) -> Figure:
    """Lines in a plane with two logarithmic axes."""
    figure = _figure(7.4, 4.4)
    axis = figure.subplots()
    for number, (name, (places, heights)) in enumerate(lines.items()):
        axis.loglog(places, heights, marker=MARKERS[number % len(MARKERS)], markersize=5, linewidth=1.4, label=name)
    ticks = sorted({place for places, _ in lines.values() for place in places})
    if ticks[-1] < 100:
        axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axis.minorticks_off()
    axis.set(xlabel=x, ylabel=y)
    axis.set_title(title, fontsize=10)
    axis.grid(True, which="major", alpha=0.25)
    axis.legend(frameon=False, fontsize=8)
    return figure


def points(
    places: Mapping[str, tuple[float, float]],
    *,
    x: str,
    y: str,
    title: str,
    logarithmic_x: bool = False,
    front: bool = False,
) -> Figure:
    """Points named "THING, VARIANT": a colour for each thing and a marker for each variant, on a logarithmic height.

    Low and left is good where a `front` is drawn.
    """
    figure = _figure(8.4, 4.6)
    axis = figure.subplots()
    if front:
        ordered = sorted(places.values())
        lowest = np.minimum.accumulate([height for _, height in ordered])
        axis.step(
            [place for place, _ in ordered], lowest, where="post", color="0.85", linewidth=7, zorder=0, label="front"
        )
    things, variants = (list(dict.fromkeys(name.split(", ")[half] for name in places)) for half in range(2))
    for name, (place, height) in places.items():
        thing, variant = name.split(", ")
        marker, colour = MARKERS[variants.index(variant) % len(MARKERS)], f"C{things.index(thing)}"
        axis.plot(place, height, marker, color=colour, markersize=7)
    for number, thing in enumerate(things):
        axis.plot([], [], color=f"C{number}", linewidth=4, label=thing)
    for number, variant in enumerate(variants):
        axis.plot([], [], MARKERS[number % len(MARKERS)], color="0.4", label=variant)
    axis.set_yscale("log")
    if logarithmic_x:
        axis.set_xscale("log")
    axis.set(xlabel=x, ylabel=y)
    axis.set_title(title, fontsize=10)
    axis.grid(True, which="major", alpha=0.25)
    figure.legend(frameon=False, fontsize=8, loc="outside right center")
    return figure


def panels(lines: Mapping[str, Mapping[str, tuple[Sequence[float], Sequence[float]]]], *, x: str, y: str) -> Figure:
    """A panel of lines for each name, with one legend; a line "NAME, learned" has the colour of NAME and is dashed."""
    figure = _figure(3.6 * len(lines) + 2.0, 3.8)
    axes = figure.subplots(1, len(lines), squeeze=False)[0]
    names = [name for name in dict.fromkeys(name for each in lines.values() for name in each) if ", " not in name]
    handles = {}
    for axis, (title, each) in zip(axes, lines.items(), strict=True):
        for name, (places, heights) in each.items():
            number = names.index(name.split(", ")[0])
            style = "--" if ", " in name else "-"
            (handles[name],) = axis.loglog(
                places,
                heights,
                style,
                color=f"C{number}",
                marker=MARKERS[number % len(MARKERS)],
                markersize=4,
                linewidth=1.3,
            )
        axis.set_title(title, fontsize=10)
        axis.set_xlabel(x)
        axis.grid(True, which="major", alpha=0.25)
    axes[0].set_ylabel(y)
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside right center")
    return figure


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    return figure
