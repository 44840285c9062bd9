"""Figures of an ensemble of learned functions: what it says where it has data, and where it has none."""

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from dln_jax.data.functions import FunctionSamples
from dln_jax.figures import style
from dln_jax.figures.functions import HALO, MODEL, POSITIVE, TITLES, square


def ensemble(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """An ensemble of functions of one or two inputs, inside and outside the data in [-bound, bound]."""
    if truth.inputs == 1:
        return ensemble_curves(truth, mean, spread, bound=bound)
    return ensemble_maps(spread, bound=bound)


def ensemble_curves(truth: FunctionSamples, mean: FunctionSamples, spread: FunctionSamples, *, bound: float) -> Figure:
    """Mean and twice the spread of an ensemble over one input, inside and outside the data in [-bound, bound].

    Below, logarithmic, the spread beside the error: of a well-trained ensemble the band above is a line.
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


def ensemble_maps(spread: FunctionSamples, *, bound: float) -> Figure:
    """Spread of value, gradient and Hessian (root of the sum over components) over two inputs.

    Logarithmic where it spans a decade. The frame is the box of the training data, [-bound, bound]².
    """
    figure, axes = style.figure(1, 3, height=3.4, sharey=True)
    grid = [square(spread.x[:, axis]) for axis in range(2)]
    for axis, (key, text) in zip(axes[0], TITLES.items(), strict=True):
        array = getattr(spread, key)
        sizes = square(np.sqrt((array.reshape(len(array), -1) ** 2).sum(axis=1)))
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
