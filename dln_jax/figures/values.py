"""Figure of a value function and its policy in the plane of one coordinate and its rate, with closed-loop paths."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.closed_loops import angle_ticks
from dln_jax.types import JointKind

LEVELS = 16


def value_slice(
    nodes: Float[np.ndarray, "A B 2"],
    V: Float[np.ndarray, "A B"],
    u: Float[np.ndarray, "A B"],
    paths: Float[np.ndarray, "N T 2"],
    *,
    name: str,
    kind: JointKind,
    limit: float,
    fixed: bool,
) -> Figure:
    """V and the first control with all other states at the goal, and closed-loop paths projected onto the plane.

    Args:
        nodes: a coordinate, relative to the goal, and its rate.
        V: value at the nodes.
        u: first control at the nodes.
        paths: closed-loop coordinates, relative to the goal, and rates.
        kind: kind of the coordinate, for units.
        fixed: whether there are other states, so that paths are projected.
    """
    figure, [axes] = style.figure(1, 2, height=3.6)
    unit = "rad" if kind == "revolute" else "m"
    heights, controls = Normalize(0, float(np.max(V))), Normalize(-limit, limit)
    surface(axes[0], nodes, V, heights, "YlGnBu")
    axes[0].contour(*sides(nodes), V.T, np.linspace(0, float(np.max(V)), LEVELS), colors="0.25", linewidths=0.35)
    colour_bar(figure, ScalarMappable(heights, "YlGnBu"), axes[0], "V")
    surface(axes[1], nodes, u, controls, "RdBu_r")
    colour_bar(figure, ScalarMappable(controls, "RdBu_r"), axes[1], "control, N or N m")
    for axis, title in zip(axes, ("value", "policy"), strict=True):
        path_curves(axis, paths, turning=kind == "revolute")
        style.title(axis, f"{title}, other states at the goal" if fixed else title)
        axis.set(xlim=nodes[[0, -1], 0, 0], ylim=nodes[0, [0, -1], 1], xlabel=f"{name} from the goal, {unit}")
        if kind == "revolute" and nodes[-1, 0, 0] > 3:
            angle_ticks(axis.xaxis)
    axes[0].set_ylabel(f"rate, {unit}/s")
    return figure


def sides(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the coordinates of a grid's columns and rows."""
    return nodes[:, 0, 0], nodes[0, :, 1]


def surface(axis: Axes, nodes: np.ndarray, values: np.ndarray, norm: Normalize, colours: str) -> ScalarMappable:
    """Draws the values at the nodes as colours."""
    axis.grid(False)
    return axis.pcolormesh(*sides(nodes), values.T, norm=norm, cmap=colours, shading="gouraud", rasterized=True)


def colour_bar(figure: Figure, shown: ScalarMappable, axis: Axes, label: str) -> None:
    """Draws the colour scale of an axis."""
    bar = figure.colorbar(shown, ax=axis, pad=0.02, aspect=28)
    bar.set_label(label, fontsize=style.SMALL)
    bar.ax.tick_params(labelsize=style.SMALL)
    bar.outline.set_visible(False)


def path_curves(axis: Axes, paths: np.ndarray, *, turning: bool = True) -> None:
    """Draws paths; angles of a joint that turns freely are wrapped, with gaps where they jump."""
    for path in paths:
        angle = path[:, 0]
        if turning:
            angle = np.arctan2(np.sin(angle), np.cos(angle))
            angle[1:][np.abs(np.diff(angle)) > np.pi] = np.nan
        axis.plot(angle, path[:, 1], color=style.VERMILLION, linewidth=0.8, alpha=0.8)
    axis.plot(0, 0, "o", color="white", markeredgecolor="black", markersize=4.5)
