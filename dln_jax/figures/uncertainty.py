"""Figures of model uncertainty: torques in their bands, and the coverage of the bands."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style
from dln_jax.metrics.coverage import LEVEL, coverage, half_width

MOST_JOINTS, MOST_SAMPLES = 7, 400
"""Largest numbers of joints and samples shown."""


def torque_bands(
    data: Trajectories,
    predicted: Float[np.ndarray, "N d"],
    std: Float[np.ndarray, "N d"],
    outside: np.ndarray,
    *,
    model: str = "model",
) -> Figure:
    """Torque errors in their 95 % bands along the first held-out samples, one row per joint, next to their coverage.

    States flagged as out of distribution are shaded. `predicted` and `std` are the model's; its name sets the colour.
    """
    d = min(data.degrees_of_freedom, MOST_JOINTS)
    shown = np.arange(min(len(data.t), MOST_SAMPLES))
    error = predicted - data.tau
    found = coverage(error, std)
    figure = style.blank(height=max(2.6, 0.85 * d + 0.9))
    grid = figure.add_gridspec(d, 2, width_ratios=[1.7, 1.0])
    starts = np.flatnonzero(np.diff(data.trajectory[shown]) != 0) + 0.5
    shade = style.colour(model)
    axes = [figure.add_subplot(grid[joint, 0]) for joint in range(d)]
    bands = half_width(LEVEL) * std[shown]
    within = np.maximum(np.quantile(bands, 0.98, axis=0), np.quantile(np.abs(error[shown]), 0.995, axis=0))
    # One unit for all joints, so that their errors can be compared.
    factor, prefix = style.prefixed(float(within[:d].max()), "")
    for joint, axis in enumerate(axes):
        style.prepare(axis)
        band = bands[:, joint]
        axis.fill_between(shown, -band / factor, band / factor, color=shade, alpha=0.25, linewidth=0, label="95 % band")
        axis.plot(shown, error[shown, joint] / factor, color="black", linewidth=0.8, label="predicted minus measured")
        largest = 1.1 * within[joint] / factor
        axis.set_ylim(-largest, largest)
        for first, last in _segments(outside[shown]):
            axis.axvspan(first - 0.5, last + 0.5, color="0.5", alpha=0.25, linewidth=0)
        for start in starts:
            axis.axvline(start, color="0.75", linewidth=0.8, zorder=0)
        unit = "N" if data.needs is not None and data.needs.joints[joint] == "prismatic" else "N m"
        axis.set_ylabel(f"joint {joint + 1},\n{prefix}{unit}")
        axis.tick_params(axis="x", labelbottom=joint == d - 1)
        axis.margins(x=0.01)
    style.legend(figure, *axes[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
    axes[-1].set_xlabel("held-out sample; grey: outside the training data")
    right = figure.add_subplot(grid[:, 1])
    style.prepare(right)
    right.plot([0, 1], [0, 1], color=style.REFERENCE, linewidth=1.0)
    right.fill_between([0, 1], [-0.05, 0.95], [0.03, 1.03], color=style.REFERENCE, alpha=0.15, linewidth=0)
    for joint in range(d):
        right.plot(
            found.levels, found.shares[:, joint], color=style.CYCLE[joint], linewidth=1.2, label=f"joint {joint + 1}"
        )
    right.set(xlim=(0, 1), ylim=(0, 1), xlabel="level of the band", ylabel="share of torques in it")
    style.legend(right, loc="lower right")
    return figure


def _segments(flags: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of every run of true values."""
    edges = np.diff(np.r_[0, np.asarray(flags, int), 0])
    return list(zip(np.flatnonzero(edges == 1).tolist(), (np.flatnonzero(edges == -1) - 1).tolist(), strict=True))
