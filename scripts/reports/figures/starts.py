"""Success over starts: the time to the goal from every start in the phase plane of a pole."""

from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks


def success_over_starts(starts: Any, seconds: Any) -> Figure:
    """Starts [K, 2] in the plane of the angle from upright and its rate, coloured by the time to the goal.

    `seconds` [K] are infinite or NaN if the goal was not reached; crosses mark these starts.
    """
    starts, seconds = np.asarray(starts), np.asarray(seconds)
    good = np.isfinite(seconds)
    figure, [[axis]] = style.figure(height=4.0)
    scale = Normalize(0.0, float(seconds[good].max()) if good.any() else 1.0)
    axis.scatter(*starts[good].T, c=seconds[good], norm=scale, cmap="viridis_r", s=22, linewidths=0)
    axis.scatter(*starts[~good].T, marker="x", color=style.VERMILLION, s=40, linewidths=1.6, zorder=3)
    bar = figure.colorbar(ScalarMappable(scale, "viridis_r"), ax=axis, pad=0.02)
    bar.set_label("up after, s", fontsize=style.TEXT)
    bar.ax.tick_params(labelsize=style.SMALL)
    angle_ticks(axis.xaxis)
    axis.set(xlabel="angle from upright, rad", ylabel="rate, rad/s")
    failed = f", {(~good).sum()} failed (crosses)" if not good.all() else ""
    style.title(axis, f"{good.sum()} of {len(good)} starts are up{failed}", loc="left")
    return figure
