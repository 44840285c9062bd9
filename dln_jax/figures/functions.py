"""Figures of learned functions: value, gradient and Hessian, truth beside model and error, and an ensemble's spread.

Each function returns a Matplotlib figure and touches no global state.
"""

from collections.abc import Iterator

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dln_jax.data.functions import FunctionSamples

TRUTH, MODEL, ERROR = "#111111", "#d1495b", "#2e6f95"
SIGNED, POSITIVE = "RdBu_r", "viridis"
TITLES = {"y": "value", "dy": "gradient", "d2y": "Hessian"}


def curves(truth: FunctionSamples, predicted: FunctionSamples, *, most_outputs: int = 4) -> Figure:
    """A function of one input: a column each for value, slope and curvature; below each output, its error."""
    order = np.argsort(truth.x[:, 0])
    x = truth.x[order, 0]
    keys = [key for key in TITLES if getattr(truth, key) is not None]
    outputs = min(truth.outputs, most_outputs)
    figure = _figure(4.4 * len(keys), 0.6 + 3.6 * outputs)
    axes = figure.subplots(2 * outputs, len(keys), sharex=True, squeeze=False, height_ratios=(2, 1) * outputs)
    for column, key in enumerate(keys):
        for output in range(outputs):
            wanted, found = (getattr(data, key)[order, output].ravel() for data in (truth, predicted))
            upper, lower = axes[2 * output, column], axes[2 * output + 1, column]
            upper.plot(x, wanted, color=TRUTH, linewidth=3.0, alpha=0.35, label="truth")
            upper.plot(x, found, color=MODEL, linewidth=1.4, label="model")
            lower.semilogy(x, np.maximum(abs(found - wanted), 1e-300), color=ERROR, linewidth=1.2, label="|error|")
            lower.set_ylim(*_decades(abs(found - wanted)))
            _name_output(upper, _symbol(key, (0,) * (list(TITLES).index(key)), truth), output, truth.outputs)
            lower.set_ylabel("|error|")
        axes[0, column].set_title(TITLES[key])
        axes[-1, column].set_xlabel("x")
    for axis in axes.flat:
        axis.grid(True, alpha=0.25)
    axes[0, 0].legend(frameon=False)
    return figure


def heat_maps(truth: FunctionSamples, predicted: FunctionSamples, *, output: int = 0) -> Figure:
    """A function of two inputs on a square grid: a row per component, with truth, model and |error| side by side."""
    components = list(_components(truth))
    figure = _figure(10.4, 0.6 + 2.75 * len(components))
    axes = figure.subplots(len(components), 3, sharex=True, sharey=True, squeeze=False)
    grid = [_square(truth.x[:, axis]) for axis in range(2)]
    for row, (key, index) in zip(axes, components, strict=True):
        wanted, found = (_square(getattr(data, key)[(slice(None), output, *index)]) for data in (truth, predicted))
        size = max(abs(wanted).max(), abs(found).max(), 1e-300)
        scale = TwoSlopeNorm(0.0, -size, size)
        for axis, values in zip(row[:2], (wanted, found), strict=True):
            axis.pcolormesh(*grid, values, norm=scale, cmap=SIGNED, rasterized=True)
        figure.colorbar(ScalarMappable(scale, SIGNED), ax=row[1], pad=0.02)
        error = abs(found - wanted)
        image = row[2].pcolormesh(*grid, error, norm=Normalize(0, error.max() or 1), cmap=POSITIVE, rasterized=True)
        bar = figure.colorbar(image, ax=row[2], pad=0.02)
        bar.ax.ticklabel_format(axis="y", scilimits=(-2, 2))
        row[0].set_ylabel(f"{_symbol(key, index, truth)}\n\n$x_2$", fontsize=12)
    for axis, title in zip(axes[0], ("truth", "model", "|error|"), strict=True):
        axis.set_title(title)
    for axis in axes[-1]:
        axis.set_xlabel("$x_1$")
    for axis in axes.flat:
        axis.set_aspect("equal")
    return figure


def surfaces(truth: FunctionSamples, predicted: FunctionSamples, *, output: int = 0) -> Figure:
    """The same as surfaces: rows for value, length of the gradient and trace of the Hessian."""
    keys = [key for key in TITLES if getattr(truth, key) is not None]
    names = {"y": "$f$", "dy": r"$|\nabla f|$", "d2y": r"trace $\nabla^2 f$"}
    figure = _figure(11.5, 0.4 + 3.5 * len(keys))
    grid = [_square(truth.x[:, axis]) for axis in range(2)]
    for row, key in enumerate(keys):
        wanted, found = (_square(_scalar(key, getattr(data, key)[:, output])) for data in (truth, predicted))
        limits = min(wanted.min(), found.min()), max(wanted.max(), found.max())
        error, colours = abs(found - wanted), POSITIVE if key == "dy" else SIGNED
        panels = ((wanted, "truth", limits, colours), (found, "model", limits, colours))
        panels = (*panels, (error, "|error|", (0, error.max() or 1), POSITIVE))
        for column, (values, title, limits, colours) in enumerate(panels):
            axis = figure.add_subplot(len(keys), 3, 3 * row + column + 1, projection="3d")
            style = {"cmap": colours, "norm": Normalize(*limits), "linewidth": 0, "antialiased": False}
            axis.plot_surface(*grid, values, rcount=50, ccount=50, **style)  # type: ignore[attr-defined]
            axis.set_zlim(*limits)  # type: ignore[attr-defined]
            axis.set_title(f"{names[key]}, {title}", fontsize=11)
            axis.set_xlabel("$x_1$")
            axis.set_ylabel("$x_2$")
            axis.tick_params(labelsize=7)
            axis.locator_params(nbins=5)
            axis.ticklabel_format(axis="z", scilimits=(-2, 3))  # type: ignore[arg-type]
    return figure


def parity(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Model against truth for any number of inputs and outputs, all components in one cloud per quantity.

    Give both in standard units, in which components are of comparable size.
    """
    keys = [key for key in TITLES if getattr(truth, key) is not None]
    figure = _figure(4.2 * len(keys), 4.4)
    for axis, key in zip(figure.subplots(1, len(keys), squeeze=False)[0], keys, strict=True):
        wanted, found = (getattr(data, key).ravel() for data in (truth, predicted))
        ends = [min(wanted.min(), found.min()), max(wanted.max(), found.max())]
        axis.plot(ends, ends, color=TRUTH, linewidth=1.0, alpha=0.5, zorder=0)
        axis.plot(wanted, found, ".", color=MODEL, markersize=5, alpha=0.5, markeredgewidth=0, rasterized=True)
        axis.set_title(f"{TITLES[key]}, {len(wanted):,} numbers")
        axis.set_xlabel("truth, standard units")
        axis.set_ylabel("model, standard units")
        axis.grid(True, alpha=0.25)
    return figure


def ensemble(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """An ensemble of functions of one or two inputs, inside and outside the data in [-bound, bound]."""
    if truth.inputs == 1:
        return ensemble_curves(truth, mean, spread, bound=bound)
    return ensemble_maps(spread, bound=bound)


def ensemble_curves(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """Mean and twice the spread of an ensemble over one input, inside and outside the data in [-bound, bound].

    Below, logarithmic, the spread beside the error: of a well-trained ensemble the band above is a line.
    """
    figure = _figure(13.0, 6.4)
    x = truth.x[:, 0]
    above, below = figure.subplots(2, 3, sharex=True, height_ratios=(3, 2))
    for axis, sizes, (key, title) in zip(above, below, TITLES.items(), strict=True):
        wanted, centre, width = (getattr(data, key).ravel() for data in (truth, mean, spread))
        axis.axvspan(-bound, bound, color="0.93", zorder=0, label="training data")
        axis.plot(x, wanted, color=TRUTH, linewidth=3.0, alpha=0.35, label="truth")
        axis.fill_between(
            x, centre - 2 * width, centre + 2 * width, color=MODEL, alpha=0.3, linewidth=0, label="± 2 sd"
        )
        axis.plot(x, centre, color=MODEL, linewidth=1.4, label="ensemble mean")
        room = 0.6 * np.ptp(wanted)
        axis.set_ylim(wanted.min() - room, wanted.max() + room)
        axis.set_xlim(x.min(), x.max())
        axis.set_title(title)
        axis.grid(True, alpha=0.25)
        sizes.axvspan(-bound, bound, color="0.93", zorder=0)
        sizes.semilogy(x, 2 * width, color=MODEL, linewidth=1.4, label="2 sd")
        sizes.semilogy(x, np.abs(centre - wanted), color=TRUTH, linewidth=1.0, label="|mean - truth|")
        sizes.set_xlabel("x")
        sizes.grid(True, alpha=0.25)
    labelled = dict(zip(*reversed(above[0].get_legend_handles_labels()), strict=True))
    labelled.update(zip(*reversed(below[0].get_legend_handles_labels()), strict=True))
    figure.legend(labelled.values(), labelled.keys(), loc="outside lower center", ncols=6, frameon=False)
    return figure


def ensemble_maps(spread: FunctionSamples, *, bound: float) -> Figure:
    """Spread of value, gradient and Hessian (root of the sum over components) over two inputs, logarithmic.

    The frame is the box of the training data, [-bound, bound]².
    """
    figure = _figure(13.0, 4.1)
    grid = [_square(spread.x[:, axis]) for axis in range(2)]
    for axis, (key, title) in zip(figure.subplots(1, 3, sharey=True), TITLES.items(), strict=True):
        array = getattr(spread, key)
        sizes = _square(np.sqrt((array.reshape(len(array), -1) ** 2).sum(axis=1)))
        bottom, top = _decades(sizes)
        scale = LogNorm(bottom, top / 2)
        axis.pcolormesh(*grid, sizes, norm=scale, cmap=POSITIVE, rasterized=True)
        axis.add_patch(Rectangle((-bound, -bound), 2 * bound, 2 * bound, fill=False, edgecolor="white", linewidth=1.5))
        figure.colorbar(ScalarMappable(scale, POSITIVE), ax=axis, pad=0.02)
        axis.set_title(f"spread of the {title}")
        axis.set_xlabel("$x_1$")
        axis.set_aspect("equal")
    figure.axes[0].set_ylabel("$x_2$")
    return figure


def _components(data: FunctionSamples) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Key and index of every component that differs from the others."""
    yield "y", ()
    if data.dy is not None:
        yield from (("dy", (i,)) for i in range(data.inputs))
    if data.d2y is not None:
        yield from (("d2y", (i, j)) for i in range(data.inputs) for j in range(i, data.inputs))


def _symbol(key: str, index: tuple[int, ...], data: FunctionSamples) -> str:
    if data.inputs == 1:
        return {"y": "$f$", "dy": "$f'$", "d2y": "$f''$"}[key]
    below = "".join(rf"\partial x_{i + 1}" for i in index)
    power = "^2" if len(index) == 2 else ""
    return rf"$\partial{power} f / {below}$" if index else "$f$"


def _name_output(axis, symbol: str, output: int, outputs: int) -> None:
    axis.set_ylabel(symbol if outputs == 1 else f"{symbol}, output {output + 1}")


def _scalar(key: str, array: np.ndarray) -> np.ndarray:
    if key == "y":
        return array
    return np.linalg.norm(array, axis=1) if key == "dy" else np.trace(array, axis1=1, axis2=2)


def _square(column: np.ndarray) -> np.ndarray:
    side = round(len(column) ** 0.5)
    return column.reshape(side, side)


def _decades(sizes: np.ndarray) -> tuple[float, float]:
    """Limits of a logarithmic axis: the few decades below the largest value that most values are in."""
    top = max(float(sizes.max()), 1e-300)
    bottom = max(float(np.quantile(sizes, 0.02)), top * 1e-6)
    return (bottom / 2, top * 2) if bottom < top else (top / 10, top * 10)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    return figure
