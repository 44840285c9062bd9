"""Figures of a trained model of dynamics: forces with their errors, and paths of an arm's tip."""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.figures import style
from dln_jax.metrics.rollouts import Motion, valid_prediction_times

PARTS = {"tau": "torque", "tau_inertial": "inertial", "tau_coriolis": "Coriolis", "tau_gravity": "gravity"}
MOST_JOINTS, MOST_MOTIONS = 4, 6
"""Largest numbers of joints and motions shown."""
MOST_PATHS = 24
"""Largest number of paths shown."""
HIGH, LOW = 0.8, 0.36
"""Height of a panel of forces and of one of errors, inches."""


def force_decomposition(
    data: Trajectories,
    predicted: dict[str, np.ndarray],
    *,
    model: str = "model",
) -> Figure:
    """Torque and its parts over the first test motions, one column per joint: truth and model, with the error below.

    All errors share one scale. Motions are joined in time; single states are compared point by point.

    `data` is the test set, `predicted` [N, d] by the keys of `PARTS`; the model's name sets the colour.
    """
    shown = np.unique(data.trajectory)[:MOST_MOTIONS]
    samples = np.flatnonzero(np.isin(data.trajectory, shown))
    trajectory = data.trajectory[samples]
    starts = np.flatnonzero(np.r_[True, np.diff(trajectory) != 0])
    moving = len(samples) > 2 * len(shown)
    x = _running_time(data.t[samples], starts) if moving else np.arange(len(samples), dtype=float)
    joints = min(data.degrees_of_freedom, MOST_JOINTS)
    truths = {key: getattr(data, key) for key in PARTS}
    errors = {key: predicted[key] - truth for key, truth in truths.items() if truth is not None}
    largest = max((float(np.abs(error[samples, :joints]).max()) for error in errors.values()), default=0.0)
    factor, _ = style.prefixed(largest, "")
    rows = [(key, is_error) for key in PARTS for is_error in (False, True) if not is_error or key in errors]
    heights = [LOW if is_error else HIGH for _, is_error in rows]
    figure, axes = style.figure(len(rows), joints, height=sum(heights) + 0.9, sharex=True, height_ratios=heights)
    figure.get_layout_engine().set(h_pad=0.02, hspace=0.0)  # type: ignore[union-attr]
    shade, dash, dot = style.colour(model), "--" if moving else "", "" if moving else "."
    for axis, (key, is_error) in ((axis, row) for line, row in zip(axes, rows, strict=True) for axis in line):
        joint = axis.get_subplotspec().colspan.start
        if is_error:
            axis.plot(x, errors[key][samples, joint] / factor, "-" if moving else ".", color=shade, linewidth=0.9)
            axis.set_ylim(-1.15 * largest / factor, 1.15 * largest / factor)
        else:
            if truths[key] is not None:
                truth = truths[key][samples, joint]
                axis.plot(x, truth, "-" if moving else "o", color="black", linewidth=2.0, markersize=4, label="truth")
            found = predicted[key][samples, joint]
            axis.plot(x, found, dash, marker=dot, color=shade, linewidth=1.3, label=model)
        axis.margins(x=0.01)
        axis.tick_params(axis="x", bottom=axis is axes[-1, joint])
        for start in starts[1:]:
            axis.axvline((x[start - 1] + x[start]) / 2, color="0.75", linewidth=0.8, zorder=0)
        if joint == 0:
            name = "error" if is_error else PARTS[key]
            unit = _force_unit(data, joint)
            axis.set_ylabel(f"{name},\n{style.prefixed(largest, unit)[1] if is_error else unit}")
    for joint in range(joints):
        unit = _force_unit(data, joint)
        differs = "" if unit == _force_unit(data, 0) else f" ({unit})"
        style.title(axes[0, joint], f"joint {joint + 1}{differs}", pad=16)
        _name_motions(axes[0, joint], x, starts, [str(data.label[each]) for each in trajectory[starts]])
        axes[-1, joint].set_xlabel("time, s (test motions in turn)" if moving else "test state")
    figure.align_ylabels(axes[:, 0])
    style.legend(figure, *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _running_time(t: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Continuous time of motions joined at the median spacing of their samples."""
    steps = np.diff(t, prepend=t[0])
    steps[starts[1:]] = np.median(np.delete(steps, starts))
    return np.cumsum(steps)


def _name_motions(axis: Axes, x: np.ndarray, starts: np.ndarray, names: list[str]) -> None:
    for start, end, name in zip(starts, [*starts[1:], len(x)], names, strict=True):
        place = (x[start] + x[end - 1]) / 2, 1.04
        size = style.SMALL if len(name) < 4 else 6.5
        axis.annotate(name, place, xycoords=("data", "axes fraction"), ha="center", fontsize=size, color="0.35")


def tip_paths(
    data: Trajectories,
    tip: Callable,
    *,
    test: Trajectories,
    motions: Sequence[Motion],
    model: str = "model",
) -> Figure:
    """Test paths of an arm's tip with the model's rollouts over them, one panel each; training paths behind in grey.

    Args:
        data: all trajectories, including those of `test`.
        tip: q -> position [2] in m.
        test: test trajectories with the same indices as in `data`.
        motions: rollouts of the model from the test's first states under its torques, as `recorded_motions`, or none; a
            path ends when the prediction is no longer valid.
        model: name of the model, which sets the colour.
    """
    shown = list(np.unique(test.trajectory))[:MOST_PATHS]
    columns = min(len(shown), 4)
    rows = -(-len(shown) // columns)
    figure, axes = style.figure(rows, columns, height=2.3 * rows + 0.55, sharex=True, sharey=True)
    places = jax.jit(jax.vmap(tip))
    positions = np.asarray(places(data.q))
    for axis in axes.flat:
        axis.set_aspect("equal")
        axis.axis("off")
    times = valid_prediction_times(test, list(motions)) if motions else []
    paths = []
    if motions:
        ends = np.cumsum([len(motion.q) for motion in motions])
        paths = np.split(np.asarray(places(np.concatenate([motion.q for motion in motions]))), ends[:-1])
    training = [positions[data.trajectory == index] for index in np.setdiff1d(data.trajectory, test.trajectory)]
    for number, (axis, index) in enumerate(zip(axes.flat, shown, strict=False)):
        chosen = data.trajectory == index
        axis.add_collection(LineCollection(training[:MOST_PATHS], colors="0.88", linewidths=0.7))
        axis.plot(*positions[chosen].T, color="black", linewidth=2.2)
        axis.set_title(f"{data.label[index]} (test)", fontsize=style.SMALL)
        if number < len(times):
            t = data.t[chosen]
            valid = t - t[0] <= times[number] + 1e-9
            path = paths[number][valid]
            axis.plot(*path.T, "--", color=style.colour(model), linewidth=1.3)
            axis.plot(*path[-1], "o", color=style.colour(model), markersize=4)
            said = f"valid for {times[number]:.1f} of {t[-1] - t[0]:.1f} s"
            axis.set_title(f"{data.label[index]}: {said}", fontsize=style.SMALL)
    if len(times):
        figure.supxlabel(
            f"black: test; dashed: {model} driven by its torques until the prediction fails; grey: training",
            fontsize=style.SMALL,
        )
    return figure


def _force_unit(data: Trajectories, joint: int) -> str:
    return "N" if data.needs is not None and data.needs.joints[joint] == "prismatic" else "N m"
