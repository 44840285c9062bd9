"""Figures of soft bodies in motion: energies against time, and snapshots."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_body_drawing import EDGE, GROUND, GROUND_LINE, SKIN, drawn, flattened, floor
from dln_jax.metrics.soft_body_energies import KINETIC, TOTAL
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError
from scripts.reports.figures.labels import label_ends, label_points

COLOURS = {
    KINETIC: style.VERMILLION,
    "gravity": style.ORANGE,
    "elastic": style.BLUE,
    "ground": style.GREEN,
    "muscles": style.PURPLE,
    TOTAL: "black",
}
_HIGHEST = 3.6
"""Largest height of a panel, inches."""
_FADED = 0.75
"""How far the earliest snapshot fades towards the background."""


class Moments(NamedTuple):
    """Snapshots of one body, drawn into one panel."""

    title: str
    mesh: Mesh
    positions: Float[np.ndarray, "k n dim"]
    """Positions of every snapshot, m."""
    t: Float[np.ndarray, " k"]
    """Times of the snapshots, s."""
    ground: float | None = None
    """Slope of the ground, which passes through the origin."""
    stacked: bool = False
    """Whether snapshots are drawn one below the other, for bodies that move less than their own size."""
    labelled: int | None = None
    """Vertex beside which times are written; above the body if `None`."""


def energies_against_time(
    t: Float[np.ndarray, " T"], energies: dict[str, Float[np.ndarray, " T"]], *, taken: str | None = None, title: str
) -> Figure:
    """Energies from `motion_energies` over time; gravity and total count from the initial gravitational energy.

    If nothing feeds energy in, `taken` names what dissipates it, and the loss since the start is shaded.
    """
    power, unit = style.prefixed(max(float(np.abs(values - values[0]).max()) for values in energies.values()), "J")
    start = energies["gravity"][0] if "gravity" in energies else 0.0
    figure, [[axis]] = style.figure(height=3.4)
    colours, ends = {}, {}
    for name, values in energies.items():
        line = (values - (start if name in ("gravity", TOTAL) else 0.0)) / power
        label = "gravity (from start)" if name == "gravity" else name
        # The total is drawn wider and behind, so that a curve coinciding with it stays visible.
        width, order = (3.0, 1.9) if name == TOTAL else (1.4, 2.0)
        colours[label] = COLOURS.get(name, "0.4")
        axis.plot(t, line, color=colours[label], linewidth=width, label=name, zorder=order)
        ends[label] = (float(t[-1]), float(line[-1]))
    if taken is not None:
        total = (energies[TOTAL] - start) / power
        axis.fill_between(t, total, total[0], color="0.87", linewidth=0, zorder=0, label=taken.replace("\n", " "))
    axis.set(xlabel="t, s", ylabel=f"energy, {unit}", xlim=(t[0], t[-1]))
    style.title(axis, title)
    if taken is not None:
        style.legend(axis, handles=[axis.collections[-1]], loc="best")
    label_ends(axis, ends, colours=colours)
    return figure


def moments_figure(panels: Sequence[Moments], *, columns: int = 2, width: float = style.WIDTH) -> Figure:
    """Snapshots of bodies, one panel per body, earlier ones paler.

    Raises:
        InputError: no panel, or a panel whose positions, times and mesh do not fit.
    """
    if not panels:
        raise InputError("there is no panel; give at least one")
    pictures = [_shapes(panel) for panel in panels]
    columns = min(columns, len(panels))
    # The height of a row is that of its highest panel.
    rows = [range(i, min(i + columns, len(pictures))) for i in range(0, len(pictures), columns)]
    each = width / columns
    aspects = [np.divide(*np.diff(extent, axis=0)[0, ::-1]) for _, extent in pictures]
    shapes = [max(aspects[i] * len(row) / columns for i in row) for row in rows]
    if columns == 1:
        each = width = min(width, _HIGHEST / shapes[0] + 0.6)
    heights = [np.clip(each * shape, 1.2, _HIGHEST) + 0.55 for shape in shapes]
    figure = style.blank(height=sum(heights), width=width)
    grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
    axes = []
    for number, row in enumerate(rows):
        for place, i in enumerate(row):
            # The last panel fills the rest of its row.
            axes.append(figure.add_subplot(grid[number, place : columns if i == row[-1] else place + 1]))
            _draw(axes[-1], panels[i], *pictures[i])
    for axis, panel, (shapes_of, _) in zip(axes, panels, pictures, strict=True):
        _label_times(axis, panel, shapes_of)
    return figure


class _Shape(NamedTuple):
    polygons: np.ndarray
    colours: np.ndarray
    edges: np.ndarray
    """Colour of the lines between polygons."""
    skin: np.ndarray
    outline: np.ndarray
    """Colour of the skin."""
    level: np.ndarray
    """Position of the origin in the drawing."""
    label: str
    corner: np.ndarray
    """Position of the label."""


def _shapes(panel: Moments) -> tuple[list[_Shape], np.ndarray]:
    """The snapshots in the drawing plane, and their extent [[x, y] low, [x, y] high]."""
    positions = np.asarray(panel.positions)
    if positions.ndim != 3 or positions.shape[1:] != panel.mesh.vertices.shape or len(positions) != len(panel.t):
        raise InputError(
            f"'{panel.title}' has positions {list(positions.shape)} at {len(panel.t)} times; "
            f"expected [k, {panel.mesh.vertices.shape[0]}, {panel.mesh.dimension}] at k"
        )
    skin, plane = boundary(panel.mesh), panel.mesh.dimension == 2
    shapes, offset = [], np.zeros(2)
    pitch = 1.4 * max(float(np.ptp(flat[:, 1])) for flat in flattened(positions))
    for number, (x, t) in enumerate(zip(positions, panel.t, strict=True)):
        flat = flattened(x) + offset
        pale = 0.0 if panel.stacked else _FADED * (1.0 - number / max(len(positions) - 1, 1))
        polygons, colours = drawn(panel.mesh, skin, x)
        colours, edge, line = (colour + (1.0 - colour) * pale for colour in (colours, EDGE, SKIN))
        segments, edge = (flat[skin], edge) if plane else (np.zeros((0, 2, 2)), line)
        above = np.array([flat[:, 0].mean(), flat[:, 1].max()])
        corner = above if panel.labelled is None else flat[panel.labelled]
        shapes.append(_Shape(polygons + offset, colours, edge, segments, line, offset, f"{t:.2f} s", corner))
        offset = offset - (np.array([0.0, pitch]) if panel.stacked else 0.0)
    every = np.concatenate([shape.polygons.reshape(-1, 2) for shape in shapes])
    low, high = every.min(axis=0), every.max(axis=0)
    if panel.ground is not None and not panel.stacked:
        low[1] = min(low[1], panel.ground * low[0])
    margin = 0.05 * float((high - low).max())
    # Margins leave room for the labels.
    left, right = (1.0, 5.0) if panel.labelled is not None else (1.0, 1.0) if panel.stacked else (4.0, 2.0)
    return shapes, np.stack([low - margin * np.array([left, 1.0]), high + margin * np.array([right, 3.0])])


def _draw(axis: Axes, panel: Moments, shapes: list[_Shape], extent: np.ndarray) -> None:
    low, high = extent
    if panel.ground == 0.0 and panel.mesh.dimension == 3:
        axis.fill(*floor(np.asarray(panel.positions), 0.0).T, color=GROUND, zorder=0)
    if panel.ground is not None and panel.mesh.dimension == 2:
        ends = np.array([low[0], high[0]])
        for shape in shapes if panel.stacked else shapes[:1]:
            line = shape.level[1] + panel.ground * ends
            axis.fill_between(ends, line, line - 0.02 * (high[0] - low[0]), color=GROUND, zorder=0, linewidth=0)
            axis.plot(ends, line, color=GROUND_LINE, linewidth=1.2, zorder=1)
    for number, shape in enumerate(shapes):
        above = 2 + 3 * number
        faces: list = list(shape.colours)
        looks = {"facecolors": faces, "edgecolors": [tuple(shape.edges)], "linewidths": 0.4, "zorder": above}
        axis.add_collection(PolyCollection(list(shape.polygons), **looks))
        looks = {"colors": [tuple(shape.outline)], "linewidths": 1.0, "zorder": above + 1}
        axis.add_collection(LineCollection(list(shape.skin), **looks))
    style.prepare(axis)
    axis.grid(False)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="m")
    style.title(axis, panel.title)
    axis.locator_params(axis="x", nbins=6)
    if panel.stacked:
        axis.set_yticks([])
        axis.spines["left"].set_visible(False)
    else:
        axis.locator_params(axis="y", nbins=5)
        axis.set_ylabel("m")


def _label_times(axis: Axes, panel: Moments, shapes: list[_Shape]) -> None:
    """Places times beside or above the bodies, where there is room."""
    filled = [_inside(shape.polygons) for shape in shapes]
    ground = np.zeros((0, 2))
    if panel.ground is not None and panel.mesh.dimension == 2:
        along = np.linspace(*axis.get_xlim(), 100)
        ground = np.concatenate([np.stack([along, shape.level[1] + panel.ground * along], -1) for shape in shapes])
    corners = [shape.corner for shape in shapes]
    if panel.labelled is None and not panel.stacked and panel.mesh.dimension == 2 and len(shapes) > 1:
        for number, shape in enumerate(shapes):
            others = np.concatenate([ground, *filled[:number], *filled[number + 1 :]])
            skin = shape.skin.reshape(-1, 2)
            # A label has most room at the skin vertex farthest from all other bodies.
            corners[number] = skin[np.linalg.norm(skin[:, None] - others, axis=-1).min(axis=1).argmax()]
    points = [(shape.label, (float(x), float(y))) for shape, (x, y) in zip(shapes, corners, strict=True)]
    first = (1, 0) if panel.labelled is not None else (0, 1)
    label_points(axis, points, obstacles=np.concatenate([ground, *filled]), size=7.5, first=first)


def _inside(triangles: np.ndarray) -> np.ndarray:
    """Points spread over the triangles."""
    weights = np.array([(i, j, 4 - i - j) for i in range(5) for j in range(5 - i)]) / 4
    return np.einsum("kci,wc->kwi", triangles, weights).reshape(-1, 2)
