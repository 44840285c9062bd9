"""Figures by joint: friction against the rate, and excitation motions within their limits."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style

MOST_POINTS, MOST_COLUMNS = 4000, 4
"""Largest numbers of measured points and of columns in a figure of friction."""
MOST_JOINTS = 8
"""Largest number of joints in a figure of excitation motions."""
ROWS: dict[Literal["q", "qd", "tau"], str] = {"q": "position", "qd": "velocity", "tau": "force"}


def friction_curves(
    curves: Mapping[str, tuple[Any, Any]],
    *,
    names: Sequence[str] = (),
    measured: tuple[Any, Any] | None = None,
    rate_unit: str | Sequence[str] = "rad/s",
    force_unit: str | Sequence[str] = "N m",
) -> Figure:
    """Friction curves, one panel per joint.

    Args:
        curves: rates [N, d] of the joints, in any order, and forces [N, d], by name of the curve.
        names: names of the joints; by default their numbers.
        measured: rates and forces [N, d], for example torque minus that of the links, drawn as points; the most extreme
            hundredth may lie out of view.
        rate_unit, force_unit: one unit for all joints, or one per joint.
    """
    arrays = {name: (np.asarray(rates), np.asarray(forces)) for name, (rates, forces) in curves.items()}
    d = next(iter(arrays.values()))[0].shape[1]
    rate_units, force_units = np.broadcast_to(rate_unit, d), np.broadcast_to(force_unit, d)
    alike = len({*zip(rate_units, force_units, strict=True)}) == 1
    columns = min(d, MOST_COLUMNS)
    rows = -(-d // columns)
    figure, axes = style.figure(rows, columns, height=0.6 + 2.4 * rows)
    for axis in axes.flat[d:]:
        axis.set_visible(False)
    for joint, axis in enumerate(axes.flat[:d]):
        if measured is not None:
            rates, forces = (np.asarray(values)[:, joint] for values in measured)
            every = slice(None, None, -(-len(rates) // MOST_POINTS))
            points = {"color": style.REFERENCE, "markersize": 1.5, "rasterized": True, "label": "measured"}
            axis.plot(rates[every], forces[every], ".", **points)
            seen = [np.percentile(forces, [0.5, 99.5]), *(forces[:, joint] for _, forces in arrays.values())]
            low, high = float(min(map(np.min, seen))), float(max(map(np.max, seen)))
            room = 0.1 * (high - low) or 1.0
            axis.set_ylim(low - room, high + room)
        for colour, (name, (rates, forces)) in zip(itertools.cycle(style.CYCLE), arrays.items(), strict=False):
            order = np.argsort(rates[:, joint])
            axis.plot(rates[order, joint], forces[order, joint], color=colour, linewidth=1.3, label=name)
        axis.axhline(0, color="black", linewidth=0.5)
        axis.locator_params(axis="x", nbins=5)
        if d > 1:
            style.title(axis, names[joint] if names else f"joint {joint + 1}")
        if joint >= d - columns or not alike:
            axis.set_xlabel(f"rate, {rate_units[joint]}")
        if joint % columns == 0 or not alike:
            axis.set_ylabel(f"friction, {force_units[joint]}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    style.legend(figure, handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure


def excitation_figure(
    data: Trajectories, limits: Mapping[str, Any], *, names: Sequence[str], conditions: Mapping[str, Sequence[float]]
) -> Figure:
    """One column per joint with q, qd and tau of every motion and dashed limits; below, conditions of the regressor.

    Args:
        data: the motions, of equal length.
        limits: lower and upper limits [d, 2] by "q", "qd" and "tau"; infinite ones are not drawn.
        conditions: condition numbers of the regressor, by name of the set of motions.
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
