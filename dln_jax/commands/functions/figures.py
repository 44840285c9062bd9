"""Figures of learned functions: value, gradient and Hessian of truth and model with errors; spread of ensembles."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dln_jax.data.functions import FunctionSamples
from dln_jax.figures import style
from dln_jax.figures.training import OF_LOSSES, training_curve
from dln_jax.learning.engine.problem import Training, one_after_the_other
from dln_jax.learning.select import Trial

MODEL = style.colour("differential-network")
HALO = {"color": "black", "linewidth": 3.0, "alpha": 0.3}
"""Line style of the truth behind a model's curve."""
SIGNED, POSITIVE = "RdBu_r", "viridis"
MOST_OUTPUTS = 4
"""Largest number of outputs shown."""
TITLES = {"y": "value", "dy": "gradient", "d2y": "Hessian"}
SYMBOLS = {"y": "$f$", "dy": "$f'$", "d2y": "$f''$"}
COMPONENTS = {
    "$f$": ("y",),
    r"$\partial f / \partial x_1$": ("dy", 0),
    r"$\partial f / \partial x_2$": ("dy", 1),
    r"$\partial^2 f / \partial x_1\partial x_1$": ("d2y", 0, 0),
    r"$\partial^2 f / \partial x_1\partial x_2$": ("d2y", 0, 1),
    r"$\partial^2 f / \partial x_2\partial x_2$": ("d2y", 1, 1),
}
"""Components of a function of two inputs: field of the samples, and indices of the first output."""


def _keys(data: FunctionSamples) -> list[str]:
    return [key for key in TITLES if getattr(data, key) is not None]


def function_curves(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Draws a function of one input: columns for value, slope and curvature, with the error below every output."""
    order = np.argsort(truth.x[:, 0])
    x, keys = truth.x[order, 0], _keys(truth)
    outputs = min(truth.outputs, MOST_OUTPUTS)
    height, ratios = 0.6 + 2.7 * outputs, (2, 1) * outputs
    figure, axes = style.figure(2 * outputs, len(keys), height=height, sharex=True, height_ratios=ratios)
    for column, key in zip(axes.T, keys, strict=True):
        for output, (upper, lower) in enumerate(column.reshape(-1, 2)):
            exact, model = (getattr(data, key)[order, output].ravel() for data in (truth, predicted))
            upper.plot(x, exact, **HALO, label="truth")
            upper.plot(x, model, color=MODEL, linewidth=1.2, label="model")
            error, power = _scaled(model - exact)
            lower.plot(x, error, color=MODEL, linewidth=0.9)
            upper.set_ylabel(SYMBOLS[key] if truth.outputs == 1 else f"{SYMBOLS[key]}, output {output + 1}")
            lower.set_ylabel(f"error{power}")
        style.title(column[0], TITLES[key])
        column[-1].set_xlabel("$x$")
        figure.align_ylabels(column)
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def heat_maps(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Maps of a function of two inputs on a square grid: truth, model and error of every component."""
    figure, axes = style.figure(3, len(COMPONENTS), height=4.5, sharex=True, sharey=True)
    grid = [_square(column) for column in truth.x.T]
    for column, (symbol, (key, *index)) in zip(axes.T, COMPONENTS.items(), strict=True):
        exact, model = (_square(getattr(data, key)[(slice(None), 0, *index)]) for data in (truth, predicted))
        error, power = _scaled(model - exact)
        rows = (exact, [exact, model], None), (model, [exact, model], ""), (error, error, power.strip(", "))
        for axis, (values, scaled, label) in zip(column, rows, strict=True):
            size = float(np.abs(scaled).max()) or 1e-300
            norm = Normalize(-size, size)
            axis.pcolormesh(*grid, values, norm=norm, cmap=SIGNED, rasterized=True)
            axis.set_aspect("equal")
            axis.grid(False)
            if label is not None:
                bar = _colour_bar(figure, axis, norm, SIGNED, label=label)
                tick = float(f"{0.7 * size:.0e}")
                bar.set_ticks([-tick, tick], labels=[f"{-tick:g}", f"{tick:g}"])
        style.title(column[0], symbol, fontsize=11)
        column[2].set_xlabel("$x_1$")
    for axis, name in zip(axes[:, 0], ("truth", "model", "error"), strict=True):
        axis.set_ylabel(f"{name}\n$x_2$")
    return figure


def surfaces(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Surfaces of a function of two inputs, in rows: value, norm of the gradient and trace of the Hessian."""
    scalars = {
        "$f$": lambda data: data.y[:, 0],
        r"$|\nabla f|$": lambda data: np.linalg.norm(data.dy[:, 0], axis=1),
        r"trace $\nabla^2 f$": lambda data: data.d2y[:, 0].trace(0, 1, 2),
    }
    figure = style.blank(height=7.1)
    grid = [_square(column) for column in truth.x.T]
    for row, (name, scalar) in enumerate(scalars.items()):
        exact, model = (_square(scalar(data)) for data in (truth, predicted))
        error, power = _scaled(abs(model - exact))
        limits = float(np.min([exact, model])), float(np.max([exact, model]))
        panels = (
            (exact, "truth", limits),
            (model, "model", limits),
            (error, f"|error|{power}", (0.0, error.max() or 1.0)),
        )
        for column, (values, text, limits) in enumerate(panels):
            colours = POSITIVE if row == 1 or column == 2 else SIGNED
            axis = figure.add_subplot(len(scalars), 3, 3 * row + column + 1, projection="3d")
            look = {"cmap": colours, "norm": Normalize(*limits), "linewidth": 0, "antialiased": False}
            axis.plot_surface(*grid, values, rcount=50, ccount=50, **look)  # type: ignore[attr-defined]
            axis.set_zlim(*limits)  # type: ignore[attr-defined]
            style.title(axis, f"{name}, {text}", y=0.98)
            for label in (axis.set_xlabel("$x_1$", labelpad=-8), axis.set_ylabel("$x_2$", labelpad=-8)):
                label.set_fontsize(style.SMALL)
            axis.tick_params(labelsize=6.5, pad=-3)
            axis.locator_params(nbins=4)
    return figure


def parity(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Model against truth for any number of inputs and outputs, with all components of a quantity in one panel.

    Pass both in standard units, so that components are of comparable size.
    """
    keys = _keys(truth)
    figure, axes = style.figure(1, len(keys), height=7.0 / max(len(keys), 2) + 0.3)
    for axis, key in zip(axes[0], keys, strict=True):
        exact, model = (getattr(data, key).ravel() for data in (truth, predicted))
        ends = [min(exact.min(), model.min()), max(exact.max(), model.max())]
        axis.plot(ends, ends, color="black", linewidth=1.0, alpha=0.5, zorder=0)
        axis.plot(exact, model, ".", color=MODEL, markersize=4, alpha=0.5, markeredgewidth=0, rasterized=True)
        style.title(axis, f"{TITLES[key]}, {len(exact):,} numbers")
        axis.set(xlabel="truth, standard units", box_aspect=1)
    axes[0, 0].set_ylabel("model, standard units")
    return figure


def ensemble_curves(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, bound: float) -> Figure:
    """An ensemble of functions of one input, inside and outside the training data in [-bound, bound].

    Mean and two standard deviations, and below them spread and error on a logarithmic scale: for a well-trained
    ensemble the band above is a line.
    """
    figure, axes = style.figure(2, 3, height=4.4, sharex=True, height_ratios=(3, 2))
    x = truth.x[:, 0]
    for (upper, lower), (key, text) in zip(axes.T, TITLES.items(), strict=True):
        exact, centre, width = (getattr(data, key).ravel() for data in (truth, mean, spread))
        for axis in (upper, lower):
            axis.axvspan(-bound, bound, color="0.94", zorder=0, label="training data" if axis is upper else None)
        upper.plot(x, exact, **HALO, label="truth")
        band = {"color": MODEL, "alpha": 0.3, "linewidth": 0, "label": "± 2 sd"}
        upper.fill_between(x, centre - 2 * width, centre + 2 * width, **band)
        upper.plot(x, centre, color=MODEL, linewidth=1.2, label="ensemble mean")
        room = 0.6 * np.ptp(exact)
        upper.set(xlim=(x.min(), x.max()), ylim=(exact.min() - room, exact.max() + room))
        style.title(upper, text)
        lower.plot(x, 2 * width, "--", color=MODEL, linewidth=1.2, label="2 sd")
        lower.plot(x, np.abs(centre - exact), color="black", linewidth=0.9, label="|mean - truth|")
        lower.set_yscale(style.scale_of([*(2 * width), *np.abs(centre - exact)]))
        lower.set_xlabel("$x$")
    axes[0, 0].set_ylabel("function")
    axes[1, 0].set_ylabel("size")
    labelled = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
    handles, labels = (upper + lower for upper, lower in zip(*labelled, strict=True))
    style.legend(figure, handles, labels, loc="outside lower center", ncols=6)
    return figure


def ensemble_maps(spread: FunctionSamples, bound: float) -> Figure:
    """Maps of the spread of functions of two inputs (root of the sum of squares over components), with the box of the
    training data; logarithmic if the spread covers a decade."""
    figure, axes = style.figure(1, 3, height=3.4, sharey=True)
    grid = [_square(column) for column in spread.x.T]
    for axis, (key, text) in zip(axes[0], TITLES.items(), strict=True):
        array = getattr(spread, key)
        sizes = _square(np.linalg.norm(array.reshape(len(array), -1), axis=1))
        low, high = max(float(np.quantile(sizes, 0.02)), 1e-6 * sizes.max()), float(sizes.max())
        norm = (LogNorm if style.scale_of([low, high]) == "log" else Normalize)(low, high or 1.0)
        axis.pcolormesh(*grid, sizes, norm=norm, cmap=POSITIVE, rasterized=True)
        axis.add_patch(Rectangle((-bound, -bound), 2 * bound, 2 * bound, fill=False, edgecolor="white", linewidth=1.5))
        _colour_bar(figure, axis, norm, POSITIVE)
        style.title(axis, f"spread of the {text}")
        axis.set(xlabel="$x_1$", aspect="equal")
        axis.grid(False)
    axes[0, 0].set_ylabel("$x_2$")
    return figure


def _colour_bar(figure: Figure, axis: Axes, norm: Normalize, colours: str, *, label: str = "") -> Colorbar:
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axis, location="bottom", pad=0.03)
    bar.ax.tick_params(which="both", labelsize=style.SMALL)
    bar.set_label(label, fontsize=style.SMALL)
    return bar


def _square(column: np.ndarray) -> np.ndarray:
    """Reshapes the values of a square grid [N²] to [N, N]."""
    side = round(len(column) ** 0.5)
    return column.reshape(side, side)


def _scaled(values: np.ndarray) -> tuple[np.ndarray, str]:
    """Returns the values over a power of ten, and its label; unchanged and without a label if they are near one."""
    size = float(np.abs(values).max())
    exponent = int(np.floor(np.log10(size))) if size > 0 and np.isfinite(size) else 0
    return (values, "") if -2 <= exponent <= 2 else (values / 10.0**exponent, rf", $10^{{{exponent}}}$")


def training_figure(training: Training, trials: Sequence[Trial]) -> Figure:
    """Losses of the training, or of all widths tried, one after the other."""
    histories, before = [training.history], 0
    if trials:
        histories = [
            [at._replace(stage=f"width {trial.candidate.width}") for at in trial.outcome.history] for trial in trials
        ]
        earlier = itertools.takewhile(lambda trial: trial.outcome is not training, trials)
        before = sum(trial.outcome.history[-1].step for trial in earlier)
    return training_curve(
        one_after_the_other(histories),
        best_step=before + training.best_step,
        unit="loss, in the units of the fit",
        **OF_LOSSES,
    )
