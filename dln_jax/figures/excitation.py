"""Figure of excitation motions: positions, velocities and forces within limits, and the resulting condition."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style

MOST_JOINTS = 8
"""Largest number of joints shown."""
ROWS = {"q": "position", "qd": "velocity", "tau": "force"}


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
    parts: Any = figure.subfigures(2, 1, height_ratios=(3.4, 1.2))
    upper, lower = parts
    axes = upper.subplots(len(ROWS), joints, squeeze=False, sharex=True)
    colours = style.colours_of(data.label)
    for line, (key, word) in zip(axes, ROWS.items(), strict=True):
        for joint, axis in enumerate(line):
            style.prepare(axis)
            for index, name in enumerate(data.label):
                samples = data.trajectory == index
                axis.plot(data.t[samples], getattr(data, key)[samples, joint], color=colours[name], linewidth=0.8)
            for bound in limits[key][joint]:
                if np.isfinite(bound):
                    axis.axhline(bound, color=style.REFERENCE, linestyle="--", linewidth=0.9)
            axis.tick_params(labelsize=6.5)
            if joint == 0:
                axis.set_ylabel(f"{word}, {_unit(key, data, joint)}")
    for joint in range(joints):
        own = "" if _unit("q", data, joint) == _unit("q", data, 0) else f" ({_unit('q', data, joint)})"
        style.title(axes[0, joint], f"{names[joint]:.12}{own}", fontsize=style.SMALL)
        axes[-1, joint].set_xlabel("time, s", fontsize=style.SMALL)
    axis = lower.subplots()
    style.prepare(axis)
    for place, (name, found) in enumerate(conditions.items()):
        shade = style.REFERENCE if name == "random" else style.BLUE
        axis.plot(found, np.full(len(found), place), "o", color=shade, markersize=4, alpha=0.8)
    axis.set_yticks(range(len(conditions)), list(conditions))
    axis.set_ylim(len(conditions) - 0.5, -0.5)
    axis.set_xscale(style.scale_of([each for found in conditions.values() for each in found]))
    axis.set_xlabel("condition of the regressor, columns of unit length")
    handles = [axes[0, 0].lines[place] for place in range(len(data.label))]
    style.legend(figure, handles, list(data.label), loc="outside lower center", ncols=6)
    return figure


def _unit(key: str, data: Trajectories, joint: int) -> str:
    prismatic = data.needs is not None and data.needs.joints[joint] == "prismatic"
    return {"q": ("rad", "m"), "qd": ("rad/s", "m/s"), "tau": ("N m", "N")}[key][prismatic]
