"""Figures of a trained model; each function returns a Matplotlib figure and touches no global state."""

import itertools
from collections.abc import Callable, Sequence

import jax
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.runs import Progress

TRUTH, MODEL, TEST = "#111111", "#d1495b", "#2e6f95"
PARTS = ("tau", "tau_inertial", "tau_coriolis", "tau_gravity")
TITLES = ("torque", "inertial", "Coriolis", "gravity")


def force_decomposition(
    data: Trajectories, predicted: dict[str, np.ndarray], *, most_joints: int = 4, most_trajectories: int = 6
) -> Figure:
    """Torque and its parts over the first test trajectories: a row per joint, truth in black, model in colour."""
    shown = np.unique(data.trajectory)[:most_trajectories]
    samples = np.flatnonzero(np.isin(data.trajectory, shown))
    trajectory = data.trajectory[samples]
    starts = np.flatnonzero(np.r_[True, np.diff(trajectory) != 0])
    # Single states are no curves; they are compared point by point.
    style = "-" if len(samples) > 2 * len(shown) else "."
    rows = min(data.degrees_of_freedom, most_joints)
    figure = _figure(13.0, 1.1 + 1.9 * rows)
    axes = figure.subplots(rows, len(PARTS), sharex=True, squeeze=False)
    for row in range(rows):
        for axis, key, title in zip(axes[row], PARTS, TITLES, strict=True):
            truth = getattr(data, key)
            if truth is not None:
                axis.plot(truth[samples, row], style, color=TRUTH, linewidth=2.2, label="truth")
            model_style = "--" if style == "-" else "x"
            axis.plot(predicted[key][samples, row], model_style, color=MODEL, linewidth=1.3, label="model")
            for start in starts[1:]:
                axis.axvline(start, color="0.8", linewidth=0.8, zorder=0)
            if row == 0:
                axis.set_title(title, pad=18)
                for start, end in zip(starts, [*starts[1:], len(samples)], strict=True):
                    name = str(data.label[trajectory[start]])
                    axis.annotate(
                        name,
                        ((start + end) / 2, 1.02),
                        xycoords=("data", "axes fraction"),
                        ha="center",
                        fontsize=9 if len(name) < 4 else 6,
                        color="0.35",
                    )
            if row == rows - 1:
                axis.set_xlabel("test sample")
        axes[row, 0].set_ylabel(f"joint {row + 1}, {_force_unit(data, row)}")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return figure


LEAST_SHARE = 0.2
"""Of the steps, from which a stage's name is written above it, else upright."""


def training_curve(
    history: Sequence[Progress],
    *,
    best_step: int,
    error: str = "torque MSE",
    loss: str = "training loss (normalised)",
    unit: str = "loss, or MSE in (N m)²",
) -> Figure:
    """Training loss, validation error and test error against steps; the test error decided nothing.

    Of several seeds the medians. `error` and `loss` name what is measured, `unit` the axis. Stages are set apart by
    lines and have their names; their curves are not connected, for what they measure may differ.
    """
    figure = _figure(7.0, 4.2)
    axis = figure.subplots()
    stages = [list(ats) for _, ats in itertools.groupby(history, key=lambda at: at.stage)]
    for number, stage in enumerate(stages):
        steps = [at.step for at in stage]
        curves = (("loss", "-", TRUTH, loss), ("validation", "--", MODEL, f"validation {error}"))
        for field, style, colour, label in (*curves, ("monitor", "-", TEST, f"test {error}")):
            values = [np.median(getattr(at, field)) for at in stage]
            if not np.isnan(values).all():  # no test is monitored
                marker = "." if len(stage) < 40 else ""
                named = {"label": label} if number == 0 else {}
                axis.semilogy(steps, values, style, marker=marker, markersize=4, color=colour, **named)
    axis.axvline(best_step, color="0.6", linestyle=":", label="kept parameters")
    last = history[-1].step
    axis.set_xlim(0, max(1.02 * last, 1))
    starts = [0, *(stage[-1].step for stage in stages[:-1])]
    lengths = np.diff([*starts, last])
    upright = bool(np.any(lengths < LEAST_SHARE * last))
    for start, length, stage in zip(starts, lengths, stages, strict=True):
        if start:
            axis.axvline(start, color="0.4", linewidth=0.8)
        if upright:
            place, style = (start + 0.004 * last, 0.98), {"rotation": 90.0, "ha": "left", "va": "top"}
        else:
            place, style = (start + length / 2, 1.02), {"rotation": 0.0, "ha": "center", "va": "bottom"}
        name = axis.text(*place, stage[0].stage, transform=axis.get_xaxis_transform(), fontsize=8, color="0.3")
        name.update(style)
    axis.set_xlabel("optimiser step")
    axis.set_ylabel(unit)
    axis.grid(True, alpha=0.25)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


LEAST_ERROR_SHOWN = 1e-15
"""Of `error_against_time`: what is exact to rounding is marked at the lower edge."""


def error_against_time(curves: dict[str, tuple[Sequence[float], Sequence[float]]]) -> Figure:
    """Error against seconds of training, a curve or a point for each name, and the Pareto front: a panel per data set.

    Names are `model/data` or `model/data/optimiser`. A model has one colour, and Adam is dashed with squares. A point
    is on the front if nothing as quick has a lower error; what is exact to rounding is left out of it.
    """
    parts = {name: name.split("/") for name in curves}
    models = list(dict.fromkeys(part[0] for part in parts.values()))
    datasets = list(dict.fromkeys(part[1] for part in parts.values()))
    figure = _figure(5.2 * len(datasets) + 1.8, 4.6)
    axes = figure.subplots(1, len(datasets), sharey=True, squeeze=False)[0]
    handles = {}
    for axis, dataset in zip(axes, datasets, strict=True):
        front = []
        for name, (seconds, errors) in curves.items():
            model, its_dataset, *optimiser = parts[name]
            if its_dataset != dataset:
                continue
            exact = errors[-1] < LEAST_ERROR_SHOWN
            adam = optimiser == ["adam"]
            label = f"{model}, Adam" if adam else f"{model} (exact)" if exact else model
            (handles[label],) = axis.loglog(
                seconds,
                np.maximum(errors, LEAST_ERROR_SHOWN),
                color=f"C{models.index(model)}",
                linestyle="--" if adam else "-",
                marker="v" if exact else "s" if adam else "o",
                markevery=[len(seconds) - 1],
                linewidth=1.4,
            )
            front += [] if exact else list(zip(seconds, errors, strict=True))
        front.sort()
        lowest = np.minimum.accumulate([error for _, error in front])
        times = [second for second, _ in front]
        (handles["front"],) = axis.step(times, lowest, where="post", color="0.85", linewidth=7, zorder=0)
        axis.set_title(dataset, fontsize=10)
        axis.set_xlabel("training, s per seed, compilation included")
        axis.grid(True, which="major", alpha=0.25)
    axes[0].set_ylabel("test torque MSE, (N m)²")
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=8, loc="outside right center")
    return figure


def tip_paths(data: Trajectories, tip: Callable, *, test: Sequence[int], most_trajectories: int = 24) -> Figure:
    """The paths that an arm's tip draws, one panel a trajectory; those of the test in colour."""
    shown = np.unique(data.trajectory)[:most_trajectories]
    columns = min(len(shown), 8)
    rows = -(-len(shown) // columns)
    figure = _figure(1.5 * columns, 1.75 * rows + 0.3)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    positions = np.asarray(jax.vmap(tip)(data.q))
    for axis in axes.flat:
        axis.set_aspect("equal")
        axis.axis("off")
    for axis, index in zip(axes.flat, shown, strict=False):
        path = positions[data.trajectory == index]
        is_test = index in test
        axis.plot(*path.T, color=MODEL if is_test else TRUTH, linewidth=1.4)
        axis.set_title(f"{data.label[index]} (test)" if is_test else str(data.label[index]), fontsize=9)
    return figure


def _force_unit(data: Trajectories, joint: int) -> str:
    return "N" if data.needs is not None and data.needs.joints[joint] == "prismatic" else "N m"


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    return figure
