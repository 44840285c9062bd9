"""Figures of the experiments on letters: errors of several models, and letters written by an arm that learns."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dln_jax.figures import style
from scripts.reports.figures.costs import EXACT, exact_band, exact_ground
from scripts.reports.figures.labels import label_ends


def error_lines(curves: Mapping[str, Any], *, x: str, zero: str) -> Figure:
    """Median and range over runs of the models' errors, and below them the share of out-of-distribution samples.

    Args:
        curves: "places" [K] along x; "torque_mean_square" and "share_outside_training" [K, runs]; all others are the
            errors of models [K, runs] in (N m)².
        x: label of the x axis.
        zero: label of the line of mean squares.
    """
    places, mean_squares, share = (np.asarray(curves[key], float) for key in _NOT_MODELS)
    models = {model: np.asarray(errors, float) for model, errors in curves.items() if model not in _NOT_MODELS}
    figure, axes = style.figure(2, 1, height=4.6, sharex=True, gridspec_kw={"height_ratios": [4, 1]})
    top, bottom = axes[:, 0]
    ground = exact_ground(np.concatenate([errors.ravel() for errors in models.values()]).tolist(), EXACT)
    colours, ends = {zero: style.REFERENCE}, {zero: (float(places[-1]), float(np.median(mean_squares[-1])))}
    for model, errors in models.items():
        shown, colours[model] = np.maximum(errors, ground), style.colour(model)
        median = np.median(shown, axis=1)
        top.fill_between(places, *np.quantile(shown, (0, 1), axis=1), color=colours[model], alpha=0.15, linewidth=0)
        top.plot(places, median, marker=style.marker(model), color=colours[model], markersize=4.5, linewidth=1.4)
        ends[model] = (float(places[-1]), float(median[-1]))
    top.plot(places, np.median(mean_squares, axis=1), "--", color=colours[zero], linewidth=1.2)
    top.set(yscale="log", ylabel="test torque MSE, (N m)²")
    exact_band(top, ground)
    outside = 100 * np.median(share, axis=1)
    bottom.fill_between(places, outside, color="0.85", linewidth=0)
    bottom.plot(places, outside, color="0.4", linewidth=1.2)
    bottom.set(xlabel=x, ylabel="outside the\ntraining, %", ylim=(0, 100), xscale=style.scale_of(places))
    bottom.set_xticks(places, [f"{place:g}" for place in places])
    bottom.minorticks_off()
    figure.align_ylabels()
    label_ends(top, ends, colours=colours)
    return figure


_NOT_MODELS = ("places", "torque_mean_square", "share_outside_training")


def written_letters(curves: Mapping[str, Any], *, title: str) -> Figure:
    """Letters written with the models, in order, over their references, and all errors of the tip.

    Args:
        curves: "letters" [K]; "wanted" [K] and "paths" by model [K] of tips [N, 2], m; "errors" by model [runs, K], m,
            infinite for a lost letter.
        title: title of the figure.
    """
    letters, models = curves["letters"], list(curves["paths"])
    shown = _shown(len(letters))
    figure = style.blank(height=0.78 * len(models) + 3.4)
    figure.suptitle(title, fontsize=style.TEXT)
    grid = figure.add_gridspec(2, 1, height_ratios=[0.78 * len(models) + 0.4, 3.0])
    above, below = (figure.add_subfigure(grid[row]) for row in range(2))
    axes = above.subplots(len(models), len(shown), squeeze=False)
    for row, model in enumerate(models):
        for column, place in enumerate(shown):
            _letter(axes[row, column], curves["wanted"][place], curves["paths"][model][place], style.colour(model))
            if row == 0:
                style.title(axes[row, column], f"letter {place + 1}: {letters[place]}")
        name = model.replace("delan", "DeLaN").rsplit("-", 1)
        axes[row, 0].set_ylabel("\n".join(name), fontsize=style.SMALL, rotation=0, ha="right", va="center")
    _errors(below.subplots(), curves["errors"])
    return figure


def _shown(count: int) -> list[int]:
    """Indices of the letters to draw: the first ones, then some later ones."""
    return list(dict.fromkeys(place for place in (0, 1, 2, 4, count - 1) if place < count))


def _letter(axis: Axes, wanted: Any, path: Any, colour: str) -> None:
    wanted, path = np.asarray(wanted), np.asarray(path)
    axis.plot(*wanted.T, color="0.75", linewidth=2.5, solid_capstyle="round")
    axis.plot(*path.T, color=colour, linewidth=1.0)
    middle = (wanted.min(axis=0) + wanted.max(axis=0)) / 2
    half = 0.72 * np.ptp(wanted, axis=0).max()
    axis.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    axis.set_xticks([])
    axis.set_yticks([])
    axis.spines[:].set_visible(False)


def _errors(axis: Axes, errors: Mapping[str, Sequence[Sequence[float]]]) -> None:
    """Draws all errors and their median over runs, in the order of writing; hollow marks on top are lost letters."""
    style.prepare(axis)
    values = {model: 1e3 * np.asarray(runs, float) for model, runs in errors.items()}
    every = np.concatenate([each.ravel() for each in values.values()])
    top = 4 * every[np.isfinite(every)].max(initial=1.0)
    axis.set(yscale="log", xlabel="letter, in the order of writing", ylabel="tip error, mm (rms)")
    places = 1 + np.arange(next(iter(values.values())).shape[1])
    for number, (model, each) in enumerate(values.items()):
        look: dict[str, Any] = {"color": style.colour(model), "markersize": 4}
        beside = places + 0.06 * (number - (len(values) - 1) / 2)
        median, lost = np.median(each, axis=0), np.isinf(each)
        axis.plot(beside, np.where(np.isfinite(median), median, np.nan), color=look["color"], linewidth=1.2)
        for run in np.where(lost, np.nan, each):
            axis.plot(beside, run, style.marker(model), **look)
        hollow = beside[lost.any(axis=0)]
        axis.plot(hollow, np.full(len(hollow), top), style.marker(model), markerfacecolor="white", **look)
        axis.plot([], [], f"{style.marker(model)}-", label=model, **look)
    if np.isinf(every).any():
        axis.axhspan(top / 2, 2 * top, color="0.95", zorder=-1, linewidth=0)
        axis.text(1.0, top, " lost", transform=axis.get_yaxis_transform(), va="center", fontsize=style.SMALL)
        axis.set_ylim(top=2 * top)
    axis.set_xticks(places)
    style.legend(axis, loc="center left", bbox_to_anchor=(1.0, 0.45))
