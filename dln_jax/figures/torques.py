"""Figures of torques: parts and errors, bands, torques and friction by joint, and motions that excite them."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style
from dln_jax.metrics.errors import LEVEL, LEVELS, coverage, half_width
from dln_jax.metrics.motions import Motion, valid_prediction_times
from dln_jax.types import JointKind

PARTS = {
    "tau": "torque",
    "tau_inertial": "inertial",
    "tau_coriolis": "Coriolis",
    "tau_gravity": "gravity",
    "tau_friction": "friction",
}
MOST_JOINTS, MOST_MOTIONS, MOST_PATHS = 4, 6, 24
"""Largest numbers of joints, motions and paths shown."""
MOST_COLUMNS, MOST_EXCITED = 3, 8
"""Largest numbers of columns in a figure of friction, and of joints in one of excitation motions."""
MOST_BANDS = 40
"""Largest number of motions shown with bands."""
SHOWN = 0.995
"""Quantile of the absolute errors that sets the range of their panel."""
MOST_SAMPLES = 4000
"""Largest number of samples drawn per joint."""
ROUNDING = 1e-5
"""Parts that vary less than this share of the torque are drawn as zero."""
HIGH, LOW = 0.8, 0.36
"""Heights of a panel of forces and of a panel of errors, inches."""
QUANTITIES: dict[Literal["q", "qd", "tau"], str] = {"q": "position", "qd": "velocity", "tau": "force"}


def _on_one_axis(data: Trajectories, most: int) -> tuple[Any, ...]:
    """Samples of the first motions, their places on one axis, where motions start and break, formats and a label.

    Motions are joined in time, at the median spacing of their samples; isolated states are numbered and drawn as
    points. The formats are those of data and of a model.
    """
    samples = np.flatnonzero(np.isin(data.trajectory, np.unique(data.trajectory)[:most]))[:MOST_SAMPLES]
    starts = np.flatnonzero(np.diff(data.trajectory[samples], prepend=-1))
    x, formats, label = np.arange(len(samples), dtype=float), ("o", "."), "test state"
    if len(samples) > 2 * len(starts):
        formats, label = ("-", "--"), "time in the test, s"
        steps = np.diff(data.t[samples], prepend=data.t[samples[0]])
        steps[starts[1:]] = np.median(np.delete(steps, starts))
        x = np.cumsum(steps)
    return samples, x, starts, (x[starts[1:] - 1] + x[starts[1:]]) / 2, formats, label


def _parts(values: Mapping[str, Any], samples: np.ndarray, joints: int) -> dict[str, np.ndarray]:
    """The torque and its parts, as far as they are known; friction is the rest, if there is any."""
    parts = {key: values[key][samples, :joints] for key in PARTS if values.get(key) is not None}
    if len(parts) == len(PARTS) - 1:
        friction = 2 * parts["tau"] - sum(parts.values())
        if np.ptp(friction) > ROUNDING * np.ptp(parts["tau"]):
            parts["tau_friction"] = friction
    return parts


def force_decomposition(
    data: Trajectories, predicted: dict[str, np.ndarray], *, model: str = "model", note: str = ""
) -> Figure:
    """Torque and its parts over the first test motions, one column per joint: data and model, with the error below.

    The parts add up to the torque; the errors of a joint share one scale. Motions are joined in time; isolated states
    are compared point by point.

    `data` is the test set, `predicted` [N, d] by the keys of `PARTS`; the model's name sets the colour, and
    the legend adds a note to it.
    """
    samples, x, starts, breaks, (of_data, of_model), time = _on_one_axis(data, MOST_MOTIONS)
    joints = min(data.degrees_of_freedom, MOST_JOINTS)
    modelled, data_parts = _parts(predicted, samples, joints), _parts(data._asdict(), samples, joints)
    errors = {key: modelled[key] - data_parts[key] for key in data_parts if key in modelled}
    largest = np.max(np.abs(list(errors.values())), axis=(0, 1))
    factor, prefix = style.prefixed(float(largest.max()), "")
    rows = [(key, is_error) for key in modelled for is_error in (False, True) if not is_error or key in errors]
    heights = [LOW if is_error else HIGH for _, is_error in rows]
    figure, axes = style.figure(len(rows), joints, height=sum(heights) + 0.9, sharex=True, height_ratios=heights)
    figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)  # type: ignore[union-attr]
    shade, units = style.colour(model), [style.unit_of(data, joint) for joint in range(joints)]
    for line, (key, is_error) in zip(axes, rows, strict=True):
        for joint, axis in enumerate(line):
            if is_error:
                axis.plot(x, errors[key][:, joint] / factor, of_model[:1], color=shade, linewidth=0.9)
                limit = 1.15 * largest[joint] / factor or 1.0
                axis.set_ylim(-limit, limit)
            else:
                if key in data_parts:
                    look = {"color": "black", "linewidth": 2.0, "markersize": 4}
                    # Parts are not measured: a file that has them is of a simulation.
                    label = style.TRUTH if len(data_parts) > 1 else "measured"
                    axis.plot(x, data_parts[key][:, joint], of_data, label=label, **look)
                axis.plot(x, modelled[key][:, joint], of_model, color=shade, linewidth=1.3, label=model + note)
                if np.ptp(axis.get_ylim()) < ROUNDING * np.ptp(modelled["tau"][:, joint]):  # a part that is zero
                    axis.set_ylim(-1.0, 1.0)
            axis.margins(x=0.01)
            axis.tick_params(axis="x", bottom=line is axes[-1])
            style.separate(axis, breaks)
        line[0].set_ylabel(f"error,\n{prefix}{units[0]}" if is_error else f"{PARTS[key]},\n{units[0]}")
    for joint, (top, bottom) in enumerate(zip(axes[0], axes[-1], strict=True)):
        unit = "" if units[joint] == units[0] else f" ({units[joint]})"
        style.title(top, f"joint {joint + 1}{unit}", pad=16)
        for start, end in itertools.pairwise([*starts, len(x)]):
            name = str(data.label[data.trajectory[samples[start]]])
            place, size = ((x[start] + x[end - 1]) / 2, 1.04), style.SMALL if len(name) < 4 else 6.5
            top.annotate(name, place, xycoords=("data", "axes fraction"), ha="center", fontsize=size, color="0.35")
        bottom.set_xlabel(time)
    figure.align_ylabels(axes[:, 0])
    style.legend_beside(figure, axes[0, 0], columns=2)
    return figure


def torque_bands(
    data: Trajectories,
    predicted: Float[np.ndarray, "N d"],
    bands: tuple[Float[np.ndarray, "N d"], np.ndarray] | None = None,
    *,
    model: str = "model",
    names: Sequence[str] = (),
) -> Figure:
    """Measured torque and model over the first held-out motions, one panel per joint, with the error below.

    With bands also the 95 % bands, the share of all held-out samples within them, and the coverage of bands of every
    level. Errors and bands may leave their panel where they are largest.

    Args:
        data: held-out data.
        predicted: predicted torque of every sample.
        bands: standard deviations [N, d] of the torques, and flags [N] of states out of distribution, which are marked.
        model: name of the model, which sets the colour.
        names: names of the joints; by default their numbers.
    """
    samples, x, _, breaks, (of_data, of_model), time = _on_one_axis(data, MOST_BANDS)
    error, shade, d = predicted - data.tau, style.colour(model), data.degrees_of_freedom
    cells = d + (bands is not None)
    columns = min(cells, 2)
    rows = -(-cells // columns)
    figure = style.blank(height=0.8 + 1.55 * rows)
    grid = figure.add_gridspec(2 * rows, columns, height_ratios=[1.8, 1.0] * rows)
    panels = [grid[2 * (joint // columns) + below, joint % columns] for joint in range(d) for below in (0, 1)]
    axes = list(map(figure.add_subplot, panels))
    names = list(names) or [f"joint {joint + 1}" for joint in range(d)]
    style.prepare(*axes)
    for joint, (axis, below) in enumerate(zip(axes[::2], axes[1::2], strict=True)):
        mean, off, text = predicted[samples, joint], error[samples, joint], names[joint]
        largest, unit = 1.5 * float(np.quantile(np.abs(off), SHOWN)), style.unit_of(data, joint)
        factor, prefixed = style.prefixed(largest, unit)
        axis.plot(x, data.tau[samples, joint], of_data, color="0.45", linewidth=2.0, markersize=4, label="measured")
        axis.plot(x, mean, of_model, color=shade, linewidth=1.3, label=model)
        axis.set_ylim(axis.get_ylim())  # whatever the width of the band
        below.plot(x, off / factor, of_model[:1], color=shade, linewidth=0.9)
        limit = largest / factor or 1.0
        below.set_ylim(-limit, limit)
        if bands is not None:
            std, flags = bands
            half = half_width(LEVEL) * std[:, joint]
            text += f": {100 * np.mean(np.abs(error[:, joint]) <= half):.1f} % of samples within the band"
            for side, middle, scale in ((axis, mean, 1.0), (below, 0.0, factor)):
                low, high = ((middle + sign * half[samples]) / scale for sign in (-1, 1))
                side.fill_between(x, low, high, color=shade, alpha=0.25, linewidth=0, label="95 % band")
            if flags[samples].any():
                flagged = x[flags[samples]]
                look = {"color": style.VERMILLION, "markersize": 5, "label": "out of distribution"}
                axis.plot(flagged, 0 * flagged, "|", transform=axis.get_xaxis_transform(), **look)
        for side in (axis, below):
            style.separate(side, breaks)
            side.margins(x=0.01)
            last = side is below and joint + columns >= d
            side.tick_params(axis="x", bottom=last, labelbottom=last)
            side.set_xlabel(time if last else "")
        style.title(axis, text, loc="left", pad=3, fontsize=style.SMALL)
        axis.set_ylabel(unit)
        below.set_ylabel(f"error,\n{prefixed}")
        below.locator_params(axis="y", nbins=3)
    figure.align_ylabels(axes)
    style.legend_beside(figure, axes[0], columns=4)
    if bands is not None:
        right = figure.add_subplot(grid[d - d % 2 : d - d % 2 + 2, d % 2])
        style.prepare(right)
        right.plot([0, 1], [0, 1], color=style.REFERENCE, linewidth=1.0)
        right.fill_between([0, 1], [-0.05, 0.95], [0.03, 1.03], color=style.REFERENCE, alpha=0.15, linewidth=0)
        for name, shares in zip(names, coverage(error, bands[0]).T, strict=True):
            right.plot(LEVELS, shares, color=style.colours_of(names)[name], linewidth=1.2, label=name)
        right.set(xlim=(0, 1), ylim=(0, 1), xlabel="level of the band", ylabel="share of samples in it")
        right.set(box_aspect=1, anchor="N")
        style.legend(right, loc=(1.05, 0.0))
    return figure


def tip_paths(
    data: Trajectories,
    tip: Callable,
    *,
    test: Trajectories,
    motions: Sequence[Motion],
    model: str = "model",
) -> Figure:
    """Test paths of an arm's tip with the model's rollouts over them, one panel each; training paths in grey behind.

    Args:
        data: all trajectories, including those of `test`.
        tip: q -> position [2] in m.
        test: test trajectories with the same indices as in `data`.
        motions: rollouts from the test's first states under its torques, or none; drawn as long as they are valid.
        model: name of the model, which sets the colour.
    """
    shown = np.unique(test.trajectory)[:MOST_PATHS]
    columns = min(len(shown), 4)
    rows = -(-len(shown) // columns)
    figure, axes = style.figure(rows, columns, height=2.3 * rows + 0.55, sharex=True, sharey=True)
    places, shade = jax.jit(jax.vmap(tip)), style.colour(model)
    positions = np.asarray(places(data.q))
    training = [positions[data.trajectory == index] for index in np.setdiff1d(data.trajectory, test.trajectory)]
    predicted = []
    if motions:
        ends = np.cumsum([len(motion.q) for motion in motions])
        paths = np.split(np.asarray(places(np.concatenate([motion.q for motion in motions]))), ends[:-1])
        predicted = list(zip(valid_prediction_times(test, list(motions)), paths, strict=True))
    for axis in axes.flat:
        axis.set_aspect("equal")
        axis.axis("off")
    for number, (axis, index) in enumerate(zip(axes.flat, shown, strict=False)):
        chosen = data.trajectory == index
        axis.add_collection(LineCollection(training[:MOST_PATHS], colors="0.94", linewidths=6, capstyle="round"))
        axis.plot(*positions[chosen].T, color="black", linewidth=2.2)
        title = f"{data.label[index]} (test)"
        if number < len(predicted):
            valid, path = predicted[number]
            t = data.t[chosen] - data.t[chosen][0]
            path = path[t <= valid + 1e-9]
            axis.plot(*path.T, "--", color=shade, linewidth=1.3)
            axis.plot(*path[-1], "o", color=shade, markersize=4)
            title = f"{data.label[index]}: valid for {valid:.1f} of {t[-1]:.1f} s"
        style.title(axis, title, fontsize=style.SMALL)
    if predicted:
        caption = f"black: test; dashed: {model} driven by its torques until the prediction fails; grey: training"
        figure.supxlabel(caption, fontsize=style.SMALL)
    return figure


def friction_curves(
    curves: Mapping[str, tuple[Any, Any]],
    *,
    names: Sequence[str] = (),
    measured: tuple[Any, Any] | None = None,
    joints: Sequence[JointKind] = (),
) -> Figure:
    """Friction curves, one panel per joint.

    Args:
        curves: rates [N, d] of the joints, in any order, and forces [N, d], by name of the curve.
        names: names of the joints; by default their numbers.
        measured: rates and forces [N, d], for example torque minus that of the links, drawn as points; the most extreme
            hundredth may lie out of view.
        joints: kinds of the joints, by default revolute.
    """
    colours, d = style.colours_of(curves), np.shape(next(iter(curves.values()))[0])[1]
    units = [("m/s", "N") if kind == "prismatic" else ("rad/s", "N m") for kind in joints or ["revolute"] * d]
    columns = min(d, MOST_COLUMNS)
    rows = -(-d // columns)
    figure, axes = style.figure(rows, columns, height=0.6 + 2.4 * rows)
    for axis in axes.flat[d:]:
        axis.set_visible(False)
    for joint, axis in enumerate(axes.flat[:d]):
        drawn = {name: tuple(np.asarray(values)[:, joint] for values in curve) for name, curve in curves.items()}
        if measured is not None:
            rates, forces = (np.asarray(values)[:, joint] for values in measured)
            every = -(-len(rates) // MOST_SAMPLES)
            points = {"color": style.REFERENCE, "markersize": 1.5, "rasterized": True, "label": "measured"}
            axis.plot(rates[::every], forces[::every], ".", **points)
            seen = np.concatenate([np.percentile(forces, [0.5, 99.5]), *(forces for _, forces in drawn.values())])
            room = 0.1 * np.ptp(seen) or 1.0
            axis.set_ylim(seen.min() - room, seen.max() + room)
        for name, (rates, forces) in drawn.items():
            order = np.argsort(rates)
            axis.plot(rates[order], forces[order], color=colours[name], linewidth=1.3, label=name)
        axis.axhline(0, color="black", linewidth=0.5)
        axis.locator_params(axis="x", nbins=5)
        if d > 1:
            style.title(axis, names[joint] if names else f"joint {joint + 1}")
        axis.set_xlabel(f"rate, {units[joint][0]}")
        axis.set_ylabel(f"friction, {units[joint][1]}")
    style.legend_beside(figure, axes[0, 0], columns=4)
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
    joints = min(data.degrees_of_freedom, MOST_EXCITED)
    figure = style.blank(height=5.6)
    upper, lower = figure.subfigures(2, 1, height_ratios=(3.4, 1.2), squeeze=False)[:, 0]
    axes, below = upper.subplots(len(QUANTITIES), joints, squeeze=False, sharex=True), lower.subplots()
    style.prepare(*axes.flat, below)
    colours = style.colours_of(data.label)
    for line, (key, quantity) in zip(axes, QUANTITIES.items(), strict=True):
        for joint, axis in enumerate(line):
            for index, name in enumerate(data.label):
                samples = data.trajectory == index
                values = getattr(data, key)[samples, joint]
                axis.plot(data.t[samples], values, color=colours[name], linewidth=0.8, label=str(name))
            for bound in filter(np.isfinite, limits[key][joint]):
                axis.axhline(bound, color=style.REFERENCE, linestyle="--", linewidth=0.9)
            axis.tick_params(labelsize=6.5)
        line[0].set_ylabel(f"{quantity}, {style.unit_of(data, 0, key)}")
    units = [style.unit_of(data, joint, "q") for joint in range(joints)]
    for unit, name, column in zip(units, names, axes.T, strict=False):
        differs = "" if unit == units[0] else f" ({unit})"
        style.title(column[0], f"{name:.12}{differs}", fontsize=style.SMALL)
        column[-1].set_xlabel("time, s", fontsize=style.SMALL)
    for place, (name, values) in enumerate(conditions.items()):
        shade = style.REFERENCE if name == "random" else style.BLUE
        below.plot(values, [place] * len(values), "o", color=shade, markersize=4, alpha=0.8)
    below.set_yticks(range(len(conditions)), list(conditions))
    scale = style.scale_of(itertools.chain(*conditions.values()))
    label = "condition of the regressor, columns of unit length"
    below.set(ylim=(len(conditions) - 0.5, -0.5), xscale=scale, xlabel=label)
    style.legend_beside(figure, axes[0, 0], columns=6)
    return figure
