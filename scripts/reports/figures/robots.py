"""Figures of the robot report: errors by joint and method, and errors by arm and prior knowledge."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style

SPREAD = 0.5
"""Width over which the marks at one place are spread, relative to the distance of places."""


def errors_by_joint(errors: Mapping[str, Sequence[float]], names: Sequence[str] = ()) -> Figure:
    """nMSE by joint, with one mark per method.

    Args:
        errors: nMSE of the joints, by method.
        names: names of the joints; by default their numbers.
    """
    figure, [[axis]] = style.figure(height=3.2)
    joints = np.arange(max(map(len, errors.values())))
    shifts = SPREAD * (np.arange(len(errors)) / max(len(errors) - 1, 1) - 0.5)
    for shift, (method, values), shade, mark in zip(shifts, errors.items(), style.CYCLE, style.MARKERS, strict=False):
        axis.plot(joints + shift, values, mark, color=shade, markersize=5, label=method.replace("-", " "))
    axis.set_yscale("log")
    axis.set_xticks(joints, list(names) or [str(joint + 1) for joint in joints])
    axis.set_xlabel("" if names else "joint")
    axis.set_ylabel("nMSE, held-out motions")
    style.legend(figure, loc="outside lower center", ncols=min(len(errors), 3))
    return figure


def errors_by_arm(errors: Mapping[str, Sequence[float]]) -> Figure:
    """Median and worst nMSE, averaged over joints, by arm and method.

    Args:
        errors: median and worst over seeds, by "ARM/FRICTION/SAMPLES/METHOD".
    """
    places = list(dict.fromkeys(name.rsplit("/", 1)[0] for name in errors))
    methods = list(dict.fromkeys(name.rsplit("/", 1)[1] for name in errors))
    figure, [[axis]] = style.figure(height=0.9 + 0.28 * len(places))
    shifts = SPREAD * (np.arange(len(methods)) / max(len(methods) - 1, 1) - 0.5)
    for shift, method, shade, mark in zip(shifts, methods, style.CYCLE, style.MARKERS, strict=False):
        shown = [place for place in places if f"{place}/{method}" in errors]
        heights = [places.index(place) + shift for place in shown]
        medians, worst = np.array([errors[f"{place}/{method}"] for place in shown]).T
        axis.hlines(heights, medians, worst, color=shade, linewidth=1.2)
        axis.plot(medians, heights, mark, color=shade, markersize=5, label=method.replace("-", " "))
    axis.set_xscale("log")
    axis.set_ylim(len(places) - 0.5, -0.5)
    axis.set_yticks(range(len(places)), [place.replace("/", ", ") for place in places])
    axis.set_xlabel("nMSE on unseen motions, median (mark) to worst (line) over seeds")
    style.legend(figure, loc="outside lower center", ncols=len(methods))
    return figure
