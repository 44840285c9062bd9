"""Figures of costs: cost against size, errors against cost as lines or points, and errors against training time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dln_jax.figures import style
from scripts.reports.figures.labels import label_ends

Numbers = Sequence[float | int] | np.ndarray
Line = tuple[Numbers, Numbers]
"""(x, y)."""
EXACT = 1e-15
"""Squared errors below this are rounding errors and drawn in a separate band at the lower edge."""
FRONT = "front: nothing as cheap is more accurate"


def cost_curves(lines: Mapping[str, Line], *, x: str, y: str, title: str) -> Figure:
    """Lines labelled at their ends, with logarithmic axes if values span a decade."""
    figure, [[axis]] = style.figure(height=3.4)
    colours = style.colours_of(lines)
    for number, (name, line) in enumerate(lines.items()):
        axis.plot(
            *line, color=colours[name], marker=style.MARKERS[number % len(style.MARKERS)], markersize=4, linewidth=1.4
        )
    _scale(axis, lines.values())
    axis.set(xlabel=x, ylabel=y)
    style.title(axis, title)
    if len(lines) > 1:
        label_ends(axis, {name: (float(x[-1]), float(y[-1])) for name, (x, y) in lines.items()}, colours=colours)
    return figure


def cost_panels(lines: Mapping[str, Mapping[str, Line]], *, x: str, y: str | Sequence[str], columns: int = 2) -> Figure:
    """One panel of lines per title, with one legend; a line "NAME, learned" has the colour of NAME and is dashed.

    `y` labels the axes of all panels, or lists one label per panel.
    """
    columns = min(columns, len(lines))
    rows = -(-len(lines) // columns)
    figure, axes = style.figure(rows, columns, height=2.3 * rows + 0.8)
    every = list(dict.fromkeys(name for panel in lines.values() for name in panel))
    names = list(dict.fromkeys(name.split(", ")[0] for name in every))
    looks = {name: _look(name, names) for name in names}
    for number, (axis, (title, panel)) in enumerate(zip(axes.flat, lines.items(), strict=False)):
        for name, line in panel.items():
            colour, marker = looks[name.split(", ")[0]]
            dash = "--" if ", " in name else "-"
            axis.plot(*line, dash, color=colour, marker=marker, markersize=3.5, linewidth=1.2)
        _scale(axis, panel.values())
        style.title(axis, title)
        if number >= len(lines) - columns:
            axis.set_xlabel(x)
        if not isinstance(y, str):
            axis.set_ylabel(y[number])
        elif number % columns == 0:
            axis.set_ylabel(y)
    for axis in list(axes.flat)[len(lines) :]:
        axis.axis("off")
    handles = [
        Line2D([], [], color=colour, marker=marker, markersize=4, label=name)
        for name, (colour, marker) in looks.items()
        if len(looks) > 1
    ]
    if any(", " in name for name in every):
        handles.append(Line2D([], [], color="0.4", label="exact energy"))
        handles.append(Line2D([], [], linestyle="--", color="0.4", label="learned energy"))
    if handles:
        style.legend(figure, handles=handles, loc="outside lower center", ncols=4)
    return figure


def cost_points(
    places: Mapping[str, tuple[float, float]],
    *,
    x: str,
    y: str,
    title: str,
    front: bool = False,
    exact: float | None = None,
) -> Figure:
    """Points named "MODEL, VARIANT": a colour per model, named at the right, and a marker per variant.

    With `front`, low and left is good, and the Pareto front is drawn. Heights below `exact` are drawn in a separate
    band.
    """
    figure, [[axis]] = style.figure(height=4.0)
    models, variants = (list(dict.fromkeys(name.split(", ")[half] for name in places)) for half in range(2))
    colours = {model: style.colour(model) for model in models}
    ground = exact_ground([height for _, height in places.values()], exact)
    drawn = {name: (place, max(height, ground)) for name, (place, height) in places.items()}
    ends: dict[str, tuple[float, float]] = {}
    for name, (place, height) in drawn.items():
        model, variant = name.split(", ")
        marker = style.MARKERS[variants.index(variant)]
        axis.plot(place, height, marker, color=colours[model], markersize=6)
        ends[model] = max(ends.get(model, (place, height)), (place, height))
    if front:
        _front(axis, list(drawn.values()))
    for number, variant in enumerate(variants):
        axis.plot([], [], style.MARKERS[number], color="0.4", label=variant)
    axis.set_xscale(style.scale_of(place for place, _ in drawn.values()))
    axis.set_yscale(style.scale_of(height for _, height in drawn.values()))
    axis.set(xlabel=x, ylabel=y)
    style.title(axis, title)
    if exact is not None:
        exact_band(axis, ground)
    style.legend(figure, *axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    label_ends(axis, ends, colours=colours)
    return figure


def call_times(panels: Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]], *, x: str) -> Figure:
    """Call times by title, model, owner of the code and way to call it: one line per model, with rivals below our own.

    The first owner is ours. Colours show owners, markers ways.
    """
    sizes = [len(models) for models in panels.values()]
    height = 0.42 * sum(sizes) + 0.55 * len(sizes) + 0.9
    figure, axes = style.figure(len(sizes), 1, height=height, sharex=True, gridspec_kw={"height_ratios": sizes})
    pairs = [
        (owner, way)
        for models in panels.values()
        for model in models.values()
        for owner in model
        for way in model[owner]
    ]
    owners, ways = (list(dict.fromkeys(pair[part] for pair in pairs)) for part in range(2))
    colours, markers = style.colours_of(owners), dict(zip(ways, style.MARKERS, strict=False))
    for axis, (title, models) in zip(axes[:, 0], panels.items(), strict=True):
        for line, model in enumerate(models.values()):
            for owner, times in model.items():
                place = line + 0.25 * owners.index(owner)
                axis.plot(list(times.values()), [place] * len(times), color=colours[owner], linewidth=0.6)
                for way, value in times.items():
                    axis.plot(value, place, markers[way], color=colours[owner], markersize=5)
        axis.set_yticks(range(len(models)), list(models))
        axis.set_ylim(len(models) - 0.3, -0.5)
        axis.set_xscale("log")
        style.title(axis, title)
    axes[-1, 0].set_xlabel(x)
    handles = [Line2D([], [], color=colours[owner], label=owner) for owner in owners]
    handles += [Line2D([], [], linestyle="", marker=markers[way], color="0.4", label=way) for way in ways]
    style.legend(figure, handles=handles, loc="outside lower center", ncols=4)
    return figure


def error_against_time(curves: Mapping[str, Line]) -> Figure:
    """Error against training time, one curve or point per name, with the Pareto front; one panel per dataset.

    Names are `model/data` or `model/data/optimiser`. Adam is dashed with a hollow end marker. A point is on the front
    if nothing as fast has a lower error; results exact to rounding are left out of it.
    """
    parts = {name: name.split("/") for name in curves}
    datasets = list(dict.fromkeys(part[1] for part in parts.values()))
    figure, axes = style.figure(len(datasets), 1, height=2.5 * len(datasets) + 0.6, sharex=True)
    ground = exact_ground([error for _, errors in curves.values() for error in errors], EXACT)
    for axis, dataset in zip(axes[:, 0], datasets, strict=True):
        front, ends, colours = [], {}, {}
        for name, (seconds, errors) in curves.items():
            model, its_dataset, *optimiser = parts[name]
            if its_dataset != dataset:
                continue
            adam = optimiser == ["adam"]
            label = f"{model}, Adam" if adam else model
            colours[label] = style.colour(model)
            shown = np.maximum(errors, ground)
            axis.plot(seconds, shown, "--" if adam else "-", color=colours[label], linewidth=1.4)
            face = "white" if adam else colours[label]
            axis.plot(seconds[-1], shown[-1], style.marker(model), color=colours[label], markerfacecolor=face, zorder=3)
            ends[label] = (float(seconds[-1]), float(shown[-1]))
            front += [] if errors[-1] < EXACT else list(zip(seconds, errors, strict=True))
        _front(axis, front)
        axis.set(xscale="log", yscale="log", ylabel="test torque MSE, (N m)²")
        style.title(axis, dataset)
        exact_band(axis, ground)
        if axis is axes[0, 0]:
            for dash, face, label in (("-", "0.4", "Gauss-Newton, or one solve"), ("--", "white", "Adam")):
                axis.plot([], [], dash, marker="o", color="0.4", markerfacecolor=face, label=label)
            style.legend(figure, *axis.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        label_ends(axis, ends, colours=colours)
    axes[-1, 0].set_xlabel("training, s per seed, compilation included")
    return figure


def _look(name: str, names: Sequence[str]) -> tuple[str, str]:
    """Colour and marker: those of a known model, else by the position among the names."""
    if name in style.MODELS:
        return style.MODELS[name]
    number = names.index(name) % len(style.MARKERS)
    return style.CYCLE[number], style.MARKERS[number]


def _scale(axis: Axes, lines) -> None:
    """Logarithmic axes if values span a decade; a few distinct x values become the ticks."""
    lines = list(lines)
    places = sorted({float(place) for x, _ in lines for place in x})
    axis.set_xscale(style.scale_of(places))
    axis.set_yscale(style.scale_of(height for _, y in lines for height in y))
    if len(places) < 12 and places[-1] < 100:
        axis.set_xticks(places, [f"{place:g}" for place in places])
        axis.minorticks_off()


def _front(axis: Axes, points: list[tuple[float, float]]) -> None:
    finite = sorted(point for point in points if np.isfinite(point).all())
    lowest = np.minimum.accumulate([height for _, height in finite])
    places = [place for place, _ in finite]
    axis.step(places, lowest, where="post", color="0.85", linewidth=6, zorder=0, label=FRONT)


def exact_ground(heights: Sequence[float], exact: float | None) -> float:
    """Height of exact results in the drawing: two decades below the lowest other one."""
    if exact is None:
        return 0.0
    inexact = [height for height in heights if height >= exact]
    return 1e-2 * min(inexact, default=1.0)


def exact_band(axis: Axes, ground: float) -> None:
    """Shades the band around the ground and labels it "exact" in place of its ticks."""
    bottom, top = ground / 10, ground * 10
    axis.axhspan(bottom, top, color="0.95", zorder=-1, linewidth=0)
    axis.set_ylim(bottom=bottom)
    low, high = np.log10(axis.get_ylim())
    every = np.arange(np.ceil(np.log10(top)), np.floor(high) + 1)
    kept = every[:: max(1, round((high - low) / 7))]
    axis.set_yticks([ground, *10.0**kept], ["exact", *(f"$10^{{{exponent:.0f}}}$" for exponent in kept)])
    axis.minorticks_off()
