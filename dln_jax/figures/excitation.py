"""Figure of excitation motions: positions, velocities and forces within limits, and the resulting condition."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style

MOST_JOINTS = 8
"""Largest number of joints shown."""
ROWS: dict[Literal["q", "qd", "tau"], str] = {"q": "position", "qd": "velocity", "tau": "force"}


def excitation_figure(
    data: Trajectories, limits: Mapping[str, Any], *, names: Sequence[str], conditions: Mapping[str, Sequence[float]]
) -> Figure:
    """One column per joint with q, qd and tau of every motion and dashed limits; conditions of the regressor below.

    Args:
        data: the motions, of equal length.
        limits: by "q", "qd" and "tau", lower and upper [d, 2]; infinite limits are not drawn.
        names: names of the joints.
        conditions: conditions of the regressor, by the name of the set of motions.
    """
    joints = min(data.degrees_of_freedom, MOST_JOINTS)
    figure = style.blank(height=5.6)
    upper, lower = figure.subfigures(2, 1, height_ratios=(3.4, 1.2), squeeze=False)[:, 0]
    axes, below = upper.subplots(len(ROWS), joints, squeeze=False, sharex=True), lower.subplots()
    style.prepare(*axes.flat, below)
    colours = style.colours_of(data.label)
    for line, (key, quantity) in zip(axes, ROWS.items(), strict=True):
        for joint, axis in enumerate(line):
            for index, name in enumerate(data.label):
                samples = data.trajectory == index
                look = {"color": colours[name], "linewidth": 0.8, "label": str(name)}
                axis.plot(data.t[samples], getattr(data, key)[samples, joint], **look)
            for bound in limits[key][joint]:
                if np.isfinite(bound):
                    axis.axhline(bound, color=style.REFERENCE, linestyle="--", linewidth=0.9)
            axis.tick_params(labelsize=6.5)
        line[0].set_ylabel(f"{quantity}, {style.unit_of(data, 0, key)}")
    for joint in range(joints):
        unit = style.unit_of(data, joint, "q")
        differs = "" if unit == style.unit_of(data, 0, "q") else f" ({unit})"
        style.title(axes[0, joint], f"{names[joint]:.12}{differs}", fontsize=style.SMALL)
        axes[-1, joint].set_xlabel("time, s", fontsize=style.SMALL)
    for place, (name, values) in enumerate(conditions.items()):
        shade = style.REFERENCE if name == "random" else style.BLUE
        below.plot(values, np.full(len(values), place), "o", color=shade, markersize=4, alpha=0.8)
    below.set_yticks(range(len(conditions)), list(conditions))
    below.set_ylim(len(conditions) - 0.5, -0.5)
    below.set_xscale(style.scale_of(itertools.chain(*conditions.values())))
    below.set_xlabel("condition of the regressor, columns of unit length")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    style.legend(figure, handles, labels, loc="outside lower center", ncols=6)
    return figure
