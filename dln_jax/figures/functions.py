"""Figures of learned functions: value, gradient and Hessian of truth and model with errors, and ensembles' spread."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dln_jax.data.functions import FunctionSamples
from dln_jax.figures import style

MODEL = style.colour("differential-network")
HALO = {"color": "black", "linewidth": 3.0, "alpha": 0.3}
"""Line style of the truth behind a model's curve."""
SIGNED, POSITIVE = "RdBu_r", "viridis"
MOST_OUTPUTS = 4
"""Largest number of outputs shown."""
TITLES = {"y": "value", "dy": "gradient", "d2y": "Hessian"}


def _keys(data: FunctionSamples) -> list[str]:
    return [key for key in TITLES if getattr(data, key) is not None]


def function_curves(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """A function of one input: a column each for value, slope and curvature, with the error below every output."""
    order = np.argsort(truth.x[:, 0])
    x = truth.x[order, 0]
    keys = _keys(truth)
    outputs = min(truth.outputs, MOST_OUTPUTS)
    figure, axes = style.figure(
        2 * outputs, len(keys), height=0.6 + 2.7 * outputs, sharex=True, height_ratios=(2, 1) * outputs
    )
    for column, key in enumerate(keys):
        for output in range(outputs):
            wanted, found = (getattr(data, key)[order, output].ravel() for data in (truth, predicted))
            upper, lower = axes[2 * output, column], axes[2 * output + 1, column]
            upper.plot(x, wanted, **HALO, label="truth")
            upper.plot(x, found, color=MODEL, linewidth=1.2, label="model")
            factor, power = _power_of_ten(found - wanted)
            lower.plot(x, (found - wanted) / factor, color=MODEL, linewidth=0.9)
            symbol = _symbol(key, (0,) * (list(TITLES).index(key)), truth)
            upper.set_ylabel(symbol if truth.outputs == 1 else f"{symbol}, output {output + 1}")
            lower.set_ylabel(f"error{power}")
        style.title(axes[0, column], TITLES[key])
        axes[-1, column].set_xlabel("$x$")
        figure.align_ylabels(axes[:, column])
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def heat_maps(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Maps of a function of two inputs on a square grid (first output): truth, model and error of every component."""
    places = range(truth.inputs)  # the Hessian is symmetric
    indices = {"y": [()], "dy": [(i,) for i in places], "d2y": [(i, j) for i in places for j in places[i:]]}
    components = [(key, index) for key in _keys(truth) for index in indices[key]]
    figure, axes = style.figure(
        3, len(components), height=0.9 + 3.6 * min(1.0, 6 / len(components)), sharex=True, sharey=True
    )
    grid = [_square(truth.x[:, axis]) for axis in range(2)]
    for column, (key, index) in zip(axes.T, components, strict=True):
        wanted, found = (_square(getattr(data, key)[(slice(None), 0, *index)]) for data in (truth, predicted))
        factor, power = _power_of_ten(found - wanted)
        sizes = (abs(wanted).max(), abs(found).max(), 1e-300), (abs(found - wanted).max() / factor, 1e-300)
        scale, narrow = (Normalize(-float(max(each)), float(max(each))) for each in sizes)
        pictures = ((wanted, scale), (found, scale), ((found - wanted) / factor, narrow))
        for axis, (values, norm) in zip(column, pictures, strict=True):
            axis.pcolormesh(*grid, values, norm=norm, cmap=SIGNED, rasterized=True)
            axis.set_aspect("equal")
            axis.grid(False)
        style.title(column[0], _symbol(key, index, truth), fontsize=11)
        column[2].set_xlabel("$x_1$")
        for axis, norm, text in ((column[1], scale, ""), (column[2], narrow, power.removeprefix(", "))):
            bar = figure.colorbar(ScalarMappable(norm, SIGNED), ax=axis, location="bottom", pad=0.03, aspect=12)
            bar.ax.tick_params(labelsize=7)
            bar.ax.locator_params(nbins=2)
            bar.set_label(text, fontsize=style.SMALL)
    for axis, name in zip(axes[:, 0], ("truth", "model", "error"), strict=True):
        axis.set_ylabel(f"{name}\n$x_2$")
    return figure


def surfaces(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Surfaces of a function of two inputs: rows for value, norm of the gradient and trace of the Hessian."""
    keys = _keys(truth)
    names = {"y": "$f$", "dy": r"$|\nabla f|$", "d2y": r"trace $\nabla^2 f$"}
    scalars = {"y": np.asarray, "dy": lambda dy: np.linalg.norm(dy, axis=1), "d2y": lambda d2y: d2y.trace(0, 1, 2)}
    figure = style.blank(height=0.2 + 2.3 * len(keys))
    grid = [_square(truth.x[:, axis]) for axis in range(2)]
    for row, key in enumerate(keys):
        wanted, found = (_square(scalars[key](getattr(data, key)[:, 0])) for data in (truth, predicted))
        limits = min(wanted.min(), found.min()), max(wanted.max(), found.max())
        factor, power = _power_of_ten(found - wanted)
        error, colours = abs(found - wanted) / factor, POSITIVE if key == "dy" else SIGNED
        panels = ((wanted, "truth", limits, colours), (found, "model", limits, colours))
        panels = (*panels, (error, f"|error|{power}", (0, float(error.max()) or 1), POSITIVE))
        for column, (values, text, limits, colours) in enumerate(panels):
            axis = figure.add_subplot(len(keys), 3, 3 * row + column + 1, projection="3d")
            shown = {"cmap": colours, "norm": Normalize(*limits), "linewidth": 0, "antialiased": False}
            axis.plot_surface(*grid, values, rcount=50, ccount=50, **shown)  # type: ignore[attr-defined]
            axis.set_zlim(*limits)  # type: ignore[attr-defined]
            style.title(axis, f"{names[key]}, {text}", y=0.98)
            for label in (axis.set_xlabel("$x_1$", labelpad=-8), axis.set_ylabel("$x_2$", labelpad=-8)):
                label.set_fontsize(style.SMALL)
            axis.tick_params(labelsize=6.5, pad=-3)
            axis.locator_params(nbins=4)
    return figure


def parity(truth: FunctionSamples, predicted: FunctionSamples) -> Figure:
    """Model against truth for any number of inputs and outputs, with all components of a quantity in one panel.

    Pass both in standard units, in which components are of comparable size.
    """
    keys = _keys(truth)
    figure, axes = style.figure(1, len(keys), height=7.0 / max(len(keys), 2) + 0.3)
    for axis, key in zip(axes[0], keys, strict=True):
        wanted, found = (getattr(data, key).ravel() for data in (truth, predicted))
        ends = [min(wanted.min(), found.min()), max(wanted.max(), found.max())]
        axis.plot(ends, ends, color="black", linewidth=1.0, alpha=0.5, zorder=0)
        axis.plot(wanted, found, ".", color=MODEL, markersize=4, alpha=0.5, markeredgewidth=0, rasterized=True)
        style.title(axis, f"{TITLES[key]}, {len(wanted):,} numbers")
        axis.set(xlabel="truth, standard units", box_aspect=1)
    axes[0, 0].set_ylabel("model, standard units")
    return figure


def ensemble(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """An ensemble of functions of one or two inputs, inside and outside the training data in [-bound, bound]."""
    if truth.inputs == 1:
        return _ensemble_curves(truth, mean, spread, bound=bound)
    return _ensemble_maps(spread, bound=bound)


def _ensemble_curves(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """Mean and two standard deviations of an ensemble over one input, inside and outside the data in [-bound, bound].

    The lower panels compare spread and error on a logarithmic scale; for a well-trained ensemble the band above is a
    line.
    """
    figure, axes = style.figure(2, 3, height=4.4, sharex=True, height_ratios=(3, 2))
    x = truth.x[:, 0]
    for (upper, lower), (key, text) in zip(axes.T, TITLES.items(), strict=True):
        wanted, centre, width = (getattr(data, key).ravel() for data in (truth, mean, spread))
        upper.axvspan(-bound, bound, color="0.94", zorder=0, label="training data")
        upper.plot(x, wanted, **HALO, label="truth")
        band = {"color": MODEL, "alpha": 0.3, "linewidth": 0, "label": "± 2 sd"}
        upper.fill_between(x, centre - 2 * width, centre + 2 * width, **band)
        upper.plot(x, centre, color=MODEL, linewidth=1.2, label="ensemble mean")
        room = 0.6 * np.ptp(wanted)
        upper.set(xlim=(x.min(), x.max()), ylim=(wanted.min() - room, wanted.max() + room))
        style.title(upper, text)
        lower.axvspan(-bound, bound, color="0.94", zorder=0)
        sizes = 2 * width, np.abs(centre - wanted)
        lower.plot(x, sizes[0], "--", color=MODEL, linewidth=1.2, label="2 sd")
        lower.plot(x, sizes[1], color="black", linewidth=0.9, label="|mean - truth|")
        lower.set_yscale(style.scale_of(np.concatenate(sizes)))
        lower.set_xlabel("$x$")
    axes[0, 0].set_ylabel("function")
    axes[1, 0].set_ylabel("size")
    labelled = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
    handles, labels = (upper + lower for upper, lower in zip(*labelled, strict=True))
    style.legend(figure, handles, labels, loc="outside lower center", ncols=6)
    return figure


def _ensemble_maps(spread: FunctionSamples, *, bound: float) -> Figure:
    """Spread of value, gradient and Hessian (root of the sum of squares over components) over two inputs.

    Logarithmic if it spans a decade. The frame is the box of the training data, [-bound, bound]².
    """
    figure, axes = style.figure(1, 3, height=3.4, sharey=True)
    grid = [_square(spread.x[:, axis]) for axis in range(2)]
    for axis, (key, text) in zip(axes[0], TITLES.items(), strict=True):
        array = getattr(spread, key)
        sizes = _square(np.sqrt((array.reshape(len(array), -1) ** 2).sum(axis=1)))
        low, high = max(float(np.quantile(sizes, 0.02)), 1e-6 * sizes.max()), float(sizes.max())
        scale = (LogNorm if style.scale_of([low, high]) == "log" else Normalize)(low, high or 1.0)
        axis.pcolormesh(*grid, sizes, norm=scale, cmap=POSITIVE, rasterized=True)
        axis.add_patch(Rectangle((-bound, -bound), 2 * bound, 2 * bound, fill=False, edgecolor="white", linewidth=1.5))
        bar = figure.colorbar(ScalarMappable(scale, POSITIVE), ax=axis, location="bottom", pad=0.03)
        bar.ax.tick_params(which="both", labelsize=style.SMALL)
        style.title(axis, f"spread of the {text}")
        axis.set(xlabel="$x_1$", aspect="equal")
        axis.grid(False)
    axes[0, 0].set_ylabel("$x_2$")
    return figure


def _symbol(key: str, index: tuple[int, ...], data: FunctionSamples) -> str:
    if data.inputs == 1:
        return {"y": "$f$", "dy": "$f'$", "d2y": "$f''$"}[key]
    below = "".join(rf"\partial x_{i + 1}" for i in index)
    power = "^2" if len(index) == 2 else ""
    return rf"$\partial{power} f / {below}$" if index else "$f$"


def _square(column: np.ndarray) -> np.ndarray:
    """Reshapes the values of a square grid [N²] to [N, N]."""
    side = round(len(column) ** 0.5)
    return column.reshape(side, side)


def _power_of_ten(values: np.ndarray) -> tuple[float, str]:
    """Power of ten that scales the values, and its label; 1 and no label for values near one."""
    size = float(np.abs(values).max())
    exponent = int(np.floor(np.log10(size))) if size > 0 and np.isfinite(size) else 0
    return (1.0, "") if -2 <= exponent <= 2 else (10.0**exponent, rf", $10^{{{exponent}}}$")
