"""Figures of torques: parts and errors, bands, torques and friction by joint, and motions that excite them."""

import itertools
import re
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

PARTS = {"tau": "torque", "tau_inertial": "inertial", "tau_coriolis": "Coriolis", "tau_gravity": "gravity"}
MOST_JOINTS, MOST_MOTIONS, MOST_PATHS = 4, 6, 24
"""Largest numbers of joints, motions and paths shown."""
MOST_COLUMNS, MOST_EXCITED = 4, 8
"""Largest numbers of columns in a figure of friction, and of joints in one of excitation motions."""
MOST_BANDS, MOST_BAND_SAMPLES = 7, 400
"""Largest numbers of joints and samples shown with bands."""
MOST_SAMPLES = 4000
"""Largest number of samples drawn per joint."""
ROUNDING = 1e-9
"""Parts that vary less than this share of the torque are drawn as zero."""
HIGH, LOW = 0.8, 0.36
"""Heights of a panel of forces and of a panel of errors, inches."""
QUANTITIES: dict[Literal["q", "qd", "tau"], str] = {"q": "position", "qd": "velocity", "tau": "force"}


def force_decomposition(
    data: Trajectories, predicted: dict[str, np.ndarray], *, model: str = "model", note: str = ""
) -> Figure:
    """Torque and its parts over the first test motions, one column per joint: truth and model, with the error below.

    All errors share one scale. Motions are joined in time; isolated states are compared point by point.

    `data` is the test set, `predicted` [N, d] by the keys of `PARTS`; the model's name sets the colour, and
    the legend adds a note to it.
    """
    samples = np.flatnonzero(np.isin(data.trajectory, np.unique(data.trajectory)[:MOST_MOTIONS]))
    trajectory, joints = data.trajectory[samples], min(data.degrees_of_freedom, MOST_JOINTS)
    starts = np.flatnonzero(np.diff(trajectory, prepend=-1))
    moving = len(samples) > 2 * len(starts)
    x = np.arange(len(samples), dtype=float)
    if moving:  # motions are joined at the median spacing of their samples
        steps = np.diff(data.t[samples], prepend=data.t[samples[0]])
        steps[starts[1:]] = np.median(np.delete(steps, starts))
        x = np.cumsum(steps)
    of_truth, of_model, of_errors = ("-", "--", "-") if moving else ("o", ".-", ".")
    modelled = {key: predicted[key][samples, :joints] for key in PARTS}
    truths = {key: truth[samples, :joints] for key in PARTS if (truth := getattr(data, key)) is not None}
    errors = {key: modelled[key] - truth for key, truth in truths.items()}
    largest = float(np.max(np.abs(list(errors.values())), initial=0.0))
    factor, prefix = style.prefixed(largest, "")
    rows = [(key, is_error) for key in PARTS for is_error in (False, True) if not is_error or key in errors]
    heights = [LOW if is_error else HIGH for _, is_error in rows]
    figure, axes = style.figure(len(rows), joints, height=sum(heights) + 0.9, sharex=True, height_ratios=heights)
    figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)  # type: ignore[union-attr]
    shade, units = style.colour(model), [style.unit_of(data, joint) for joint in range(joints)]
    for line, (key, is_error) in zip(axes, rows, strict=True):
        for joint, axis in enumerate(line):
            if is_error:
                axis.plot(x, errors[key][:, joint] / factor, of_errors, color=shade, linewidth=0.9)
                axis.set_ylim(-1.15 * largest / factor, 1.15 * largest / factor)
            else:
                if key in truths:
                    truth = truths[key][:, joint]
                    axis.plot(x, truth, of_truth, color="black", linewidth=2.0, markersize=4, label="truth")
                axis.plot(x, modelled[key][:, joint], of_model, color=shade, linewidth=1.3, label=model + note)
                if np.ptp(axis.get_ylim()) < ROUNDING * np.ptp(modelled["tau"][:, joint]):  # a part that is zero
                    axis.set_ylim(-1.0, 1.0)
            axis.margins(x=0.01)
            axis.tick_params(axis="x", bottom=line is axes[-1])
            style.separate(axis, (x[starts[1:] - 1] + x[starts[1:]]) / 2)
        line[0].set_ylabel(f"error,\n{prefix}{units[0]}" if is_error else f"{PARTS[key]},\n{units[0]}")
    time = "time, s (test motions in turn)" if joints < 3 and len(starts) > 1 else "time, s"
    for joint, (top, bottom) in enumerate(zip(axes[0], axes[-1], strict=True)):
        unit = "" if units[joint] == units[0] else f" ({units[joint]})"
        style.title(top, f"joint {joint + 1}{unit}", pad=16)
        for start, end in itertools.pairwise([*starts, len(x)]):
            name = str(data.label[trajectory[start]])
            place, size = ((x[start] + x[end - 1]) / 2, 1.04), style.SMALL if len(name) < 4 else 6.5
            top.annotate(name, place, xycoords=("data", "axes fraction"), ha="center", fontsize=size, color="0.35")
        bottom.set_xlabel(time if moving else "test state")
    figure.align_ylabels(axes[:, 0])
    style.legend_beside(figure, axes[0, 0], columns=2)
    return figure


def torque_by_joint(
    data: Trajectories, predicted: Float[np.ndarray, "N d"], names: Sequence[str], units: Sequence[str]
) -> Figure:
    """Measured and predicted torque and their difference over the first motion, one row per joint.

    Args:
        data: held-out data.
        predicted: predicted torque of every sample.
        units: units of their forces, "N m" or "N".
    """
    shown = np.flatnonzero(data.trajectory == data.trajectory[0])[:MOST_SAMPLES]
    figure, axes = style.figure(len(names), 1, height=0.6 + 1.1 * len(names), sharex=True)
    for joint, axis in enumerate(axes[:, 0]):
        measured, identified = data.tau[shown, joint], predicted[shown, joint]
        for values, shade, width, label in (
            (measured, "black", 1.6, "measured"),
            (identified, style.BLUE, 1.0, "identified"),
            (identified - measured, style.VERMILLION, 0.8, "identified minus measured"),
        ):
            axis.plot(data.t[shown], values, color=shade, linewidth=width, label=label)
        style.title(axis, names[joint], loc="left", pad=2, fontsize=style.SMALL)
        axis.set_ylabel(units[joint], fontsize=style.SMALL)
        axis.margins(x=0.01)
    label = str(data.label[data.trajectory[0]])
    if block := re.fullmatch(r"(.*)\[(\d+)\]", label):  # a block of time, as `data.splits` names it
        label = f"block {int(block[2]) + 1} of recording {block[1]}"
    axes[-1, 0].set_xlabel(f"time, s (held out: {label})")
    figure.align_ylabels(axes[:, 0])
    style.legend_beside(figure, axes[0, 0], columns=3)
    return figure


def torque_bands(
    data: Trajectories,
    predicted: Float[np.ndarray, "N d"],
    std: Float[np.ndarray, "N d"],
    out_of_distribution: np.ndarray,
    *,
    model: str = "model",
) -> Figure:
    """Torque errors within their 95 % bands along the first held-out samples, one row per joint, and their coverage.

    States flagged as out of distribution are shaded. `predicted` and `std` are the model's; its name sets the colour.
    """
    d, shown = min(data.degrees_of_freedom, MOST_BANDS), np.arange(min(len(data.t), MOST_BAND_SAMPLES))
    error = predicted - data.tau
    covered = coverage(error, std)
    figure = style.blank(height=max(2.6, 0.85 * d + 0.9))
    grid = figure.add_gridspec(d, 2, width_ratios=[1.7, 1.0])
    axes = [figure.add_subplot(grid[joint, 0]) for joint in range(d)]
    right = figure.add_subplot(grid[:, 1])
    style.prepare(*axes, right)
    bands = half_width(LEVEL) * std[shown]
    within = np.maximum(np.quantile(bands, 0.98, axis=0), np.quantile(np.abs(error[shown]), 0.995, axis=0))
    # One unit for all joints, so that their errors can be compared.
    factor, prefix = style.prefixed(float(within[:d].max()), "")
    breaks = np.flatnonzero(np.diff(data.trajectory[shown])) + 0.5
    for joint, axis in enumerate(axes):
        band, largest = bands[:, joint] / factor, 1.1 * within[joint] / factor
        shade = style.colour(model)
        axis.fill_between(shown, -band, band, color=shade, alpha=0.25, linewidth=0, label="95 % band")
        axis.plot(shown, error[shown, joint] / factor, color="black", linewidth=0.8, label="predicted minus measured")
        axis.set_ylim(-largest, largest)
        flagged = np.repeat(out_of_distribution[shown], 2)
        edges = (shown[:, None] + [-0.5, 0.5]).ravel()
        axis.fill_between(edges, -largest, largest, where=flagged, color="0.5", alpha=0.25, linewidth=0)
        style.separate(axis, breaks)
        axis.set_ylabel(f"joint {joint + 1},\n{prefix}{style.unit_of(data, joint)}")
        axis.tick_params(axis="x", labelbottom=joint == d - 1)
        axis.margins(x=0.01)
    style.legend_beside(figure, axes[0], columns=2, place="outside lower left")
    axes[-1].set_xlabel("held-out sample; grey: out of distribution")
    right.plot([0, 1], [0, 1], color=style.REFERENCE, linewidth=1.0)
    right.fill_between([0, 1], [-0.05, 0.95], [0.03, 1.03], color=style.REFERENCE, alpha=0.15, linewidth=0)
    for joint, shares in enumerate(covered.T[:d]):
        right.plot(LEVELS, shares, color=style.CYCLE[joint], linewidth=1.2, label=f"joint {joint + 1}")
    right.set(xlim=(0, 1), ylim=(0, 1), xlabel="level of the band", ylabel="share of torques in it")
    style.legend(right, loc="lower right")
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
    colours, d = style.colours_of(curves), np.shape(next(iter(curves.values()))[0])[1]
    units = list(zip(np.broadcast_to(rate_unit, d), np.broadcast_to(force_unit, d), strict=True))
    alike = len({*units}) == 1
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
        if joint >= d - columns or not alike:
            axis.set_xlabel(f"rate, {units[joint][0]}")
        if joint % columns == 0 or not alike:
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
