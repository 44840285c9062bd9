"""Figures of the cost to go of a pendulum: level sets with closed-loop paths, policies, and errors."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks
from dln_jax.figures.values import LEVELS, colour_bar, path_curves, sides, surface

LEAST_ERROR, MOST_ERROR = 1e-4, 1.0
"""Range of the colour scale of relative errors."""


def value_figure(
    nodes: Float[np.ndarray, "A B 2"],
    values: tuple[np.ndarray, np.ndarray],
    controls: tuple[np.ndarray, np.ndarray],
    paths: Float[np.ndarray, "N T 2"],
    *,
    limit: float,
    seconds: float,
) -> Figure:
    """A fitted value and policy beside the true ones, the relative error, and the closed loop from downward starts.

    Args:
        nodes: states; the first coordinate is an angle, zero upright.
        values: V at the nodes [A, B], fitted and true.
        controls: controls at the nodes [A, B], fitted and true.
        paths: closed-loop states with the fitted policy.
        limit: limit of the control.
        seconds: length of the paths.
    """
    # The angle is periodic: repeat the first nodes at the end.
    nodes = np.concatenate([nodes, nodes[:1] + np.array([2 * np.pi, 0])])
    fitted, true, u, best = (np.concatenate([array, array[:1]]) for array in (*values, *controls))
    figure, axes = style.figure(3, 2, height=7.4)
    highest = float(np.max(true))
    heights, torques = Normalize(0, highest), Normalize(-limit, limit)
    for axis, V, name in zip(axes[0], (fitted, true), ("fitted value", "value on a grid"), strict=True):
        surface(axis, nodes, V, heights, "YlGnBu")
        axis.contour(*sides(nodes), V.T, np.linspace(0, highest, LEVELS), colors="0.25", linewidths=0.35)
        path_curves(axis, paths)
        style.title(axis, name)
    colour_bar(figure, ScalarMappable(heights, "YlGnBu"), axes[0, 1], "V")
    for axis, torque, name in zip(axes[1], (u, best), ("fitted policy", "policy on a grid"), strict=True):
        surface(axis, nodes, torque, torques, "RdBu_r")
        path_curves(axis, paths)
        style.title(axis, name)
    colour_bar(figure, ScalarMappable(torques, "RdBu_r"), axes[1, 1], "u, N m")
    off = np.clip(np.abs(fitted - true) / np.maximum(true, 0.01 * highest), LEAST_ERROR, MOST_ERROR)
    shown = surface(axes[2, 0], nodes, off, LogNorm(LEAST_ERROR, MOST_ERROR), "inferno")
    style.title(axes[2, 0], f"relative error, median {np.median(off):.1e}")
    colour_bar(figure, shown, axes[2, 0], "|V - V*| / V*")
    for axis in (*axes[:2].flat, axes[2, 0]):
        axis.set(xlim=(-np.pi, np.pi), ylim=(nodes[0, 0, 1], nodes[0, -1, 1]))
        angle_ticks(axis.xaxis)
    for axis in axes[:, 0]:
        axis.set_ylabel("rate, rad/s")
    for axis in (*axes[1], axes[2, 0]):
        axis.set_xlabel("angle from upright, rad")
    _over_time(axes[2, 1], paths, seconds)
    return figure


def _over_time(axis: Axes, paths: np.ndarray, seconds: float) -> None:
    t = np.linspace(0, seconds, paths.shape[1])
    for path in paths:
        # Shift every path by whole turns, so that it ends near zero.
        turns = 2 * np.pi * np.round(path[-1, 0] / (2 * np.pi))
        axis.plot(t, path[:, 0] - turns, color=style.VERMILLION, linewidth=0.9, alpha=0.8)
    axis.axhline(0, color="0.4", linewidth=0.7)
    low, high = (np.round(edge / np.pi) for edge in (axis.get_ylim()[0], axis.get_ylim()[1]))
    marks = np.pi * np.arange(low, high + 1)
    axis.set(xlim=(0, seconds), xlabel="t, s", yticks=marks)
    names = {0: "0", 1: "π", -1: "-π"}
    axis.set_yticklabels([names.get(turn := round(mark / np.pi), f"{turn}π") for mark in marks])
    style.title(axis, "angle from upright, closed loop")
