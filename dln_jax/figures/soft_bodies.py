"""Figures of soft bodies in motion: their energies against time, and pictures of a few moments."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from dln_jax.metrics.soft_body_energies import KINETIC, TOTAL
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError

COLOURS = {
    KINETIC: "#d1495b",
    "gravity": "#8a7f5c",
    "elastic": "#2e6f95",
    "ground": "#3c8d5a",
    "muscles": "#8e5ea2",
    TOTAL: "#111111",
}
_BODY, _EDGE, _SKIN = np.array((0.62, 0.75, 0.87)), np.array((0.46, 0.58, 0.71)), np.array((0.16, 0.26, 0.38))
_GROUND_LINE = (0.35, 0.33, 0.30)
# Direction of view in space, as in the animations: turned about the vertical axis, then tilted; radians.
_TURN, _TILT = np.deg2rad(-55.0), np.deg2rad(22.0)
_LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
# Inches.
_HIGHEST = 4.5
# How much of the background an earlier picture takes on.
_FADED = 0.75


class Moments(NamedTuple):
    """Pictures of one body, drawn into one panel."""

    title: str
    mesh: Mesh
    positions: Float[np.ndarray, "k n dim"]
    """In m, of each moment."""
    t: Float[np.ndarray, " k"]
    """In s."""
    ground: float | None = None
    """Rise of the ground over its run; it passes through the origin."""
    stacked: bool = False
    """Below each other and not in place: for bodies that move less than their own size."""
    labelled: int | None = None
    """Vertex beside which the times stand; above the body if `None`."""


def energies_against_time(
    t: Float[np.ndarray, " T"], energies: dict[str, Float[np.ndarray, " T"]], *, taken: str | None = None, title: str
) -> Figure:
    """Energies of `motion_energies`; the gravitational one counts from its value at the start.

    Where nothing feeds energy in, `taken` says what takes it away, and the difference to the start is shaded.
    """
    largest = max(float(np.abs(values - values[0]).max()) for values in energies.values())
    powers = {"MJ": 1e6, "kJ": 1e3, "J": 1.0, "mJ": 1e-3, "µJ": 1e-6}
    unit = next((unit for unit, power in powers.items() if largest > power), "µJ")
    power = powers[unit]
    start = energies["gravity"][0] if "gravity" in energies else 0.0
    figure = _figure(8.0, 4.2)
    axis = figure.subplots()
    for name, values in energies.items():
        shift = start if name in ("gravity", TOTAL) else 0.0
        label = "gravitational (from start)" if name == "gravity" else name
        width = 3.0 if name == TOTAL else 1.4
        # What the total coincides with stays visible.
        order = 1.9 if name == TOTAL else 2.0
        line = (values - shift) / power
        axis.plot(t, line, color=COLOURS.get(name), linewidth=width, label=label, zorder=order)
    if taken is not None:
        total = (energies[TOTAL] - start) / power
        axis.fill_between(t, total, total[0], color="0.87", linewidth=0, zorder=0, label=taken)
    axis.set(xlabel="t, s", ylabel=f"energy, {unit}", xlim=(t[0], t[-1]))
    axis.set_title(title, fontsize=10)
    axis.grid(True, alpha=0.25)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize=9)
    return figure


def moments_figure(panels: Sequence[Moments], *, columns: int = 2, width: float = 9.0) -> Figure:
    """A panel per body, each with its moments, the earlier ones paler.

    Raises:
        InputError: no panel, or a panel whose positions, times and mesh do not fit.
    """
    if not panels:
        raise InputError("there is no panel; give at least one")
    drawn = [_shapes(panel) for panel in panels]
    columns = min(columns, len(panels))
    # Every row is as high as its highest panel needs.
    rows = [range(i, min(i + columns, len(drawn))) for i in range(0, len(drawn), columns)]
    each = width / columns
    shapes = [max(_aspect(drawn[i][1]) * len(row) / columns for i in row) for row in rows]
    if columns == 1:
        each = width = min(width, _HIGHEST / shapes[0] + 0.6)
    heights = [np.clip(each * shape, 1.2, _HIGHEST) + 0.55 for shape in shapes]
    figure = _figure(width, sum(heights))
    grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
    for number, row in enumerate(rows):
        for place, i in enumerate(row):
            # The last panel takes what is left of its row.
            axis = figure.add_subplot(grid[number, place : columns if i == row[-1] else place + 1])
            _draw(axis, panels[i], *drawn[i])
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
    """Where the origin is drawn."""
    label: str
    corner: np.ndarray
    """Where the label stands."""


def _shapes(panel: Moments) -> tuple[list[_Shape], np.ndarray]:
    """The pictures in the plane of drawing, and their extent [[x, y] low, [x, y] high]."""
    positions = np.asarray(panel.positions)
    if positions.ndim != 3 or positions.shape[1:] != panel.mesh.vertices.shape or len(positions) != len(panel.t):
        raise InputError(
            f"'{panel.title}' has positions {list(positions.shape)} at {len(panel.t)} times; "
            f"expected [k, {panel.mesh.vertices.shape[0]}, {panel.mesh.dimension}] at k"
        )
    skin = boundary(panel.mesh)
    right, away, up = _view(panel.mesh.dimension)
    shapes, offset = [], np.zeros(2)
    size = np.stack([positions @ right, positions @ up], axis=-1)
    pitch = 1.4 * max(float(np.ptp(flat[:, 1])) for flat in size)
    for number, (x, t) in enumerate(zip(positions, panel.t, strict=True)):
        flat = np.stack([x @ right, x @ up], axis=-1) + offset
        pale = 0.0 if panel.stacked else _FADED * (1.0 - number / max(len(positions) - 1, 1))
        body, edge, line = (colour + (1.0 - colour) * pale for colour in (_BODY, _EDGE, _SKIN))
        if panel.mesh.dimension == 2:
            polygons, colours, segments = flat[panel.mesh.elements], body[None], flat[skin]
        else:
            corners = x[skin]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            normal = normal / np.where(length > 0, length, 1.0)
            order = np.argsort(-(corners @ away).mean(axis=1))
            order = order[(normal @ away)[order] < 0]
            polygons = flat[skin[order]]
            shaded = np.clip((0.8 + 0.2 * (normal @ _LIGHT))[order, None] * _BODY, 0, 1)
            colours = shaded + (1.0 - shaded) * pale
            segments, edge = np.zeros((0, 2, 2)), line
        above = np.array([flat[:, 0].mean(), flat[:, 1].max()])
        corner = above if panel.labelled is None else flat[panel.labelled]
        shapes.append(_Shape(polygons, colours, edge, segments, line, offset, f"{t:.2f} s", corner))
        offset = offset - (np.array([0.0, pitch]) if panel.stacked else 0.0)
    every = np.concatenate([shape.polygons.reshape(-1, 2) for shape in shapes])
    low, high = every.min(axis=0), every.max(axis=0)
    if panel.ground is not None and not panel.stacked:
        low[1] = min(low[1], panel.ground * low[0])
    margin = 0.05 * float((high - low).max())
    # Room for the labels.
    return shapes, np.stack([low - margin, high + margin * np.array([1.0, 2.0])])


def _draw(axis: Axes, panel: Moments, shapes: list[_Shape], extent: np.ndarray) -> None:
    low, high = extent
    if panel.ground == 0.0 and panel.mesh.dimension == 3:
        right, _, up = _view(3)
        (west, south), (east, north) = panel.positions[..., :2].min((0, 1)), panel.positions[..., :2].max((0, 1))
        floor = np.array([[west, south, 0.0], [east, south, 0.0], [east, north, 0.0], [west, north, 0.0]])
        axis.fill(floor @ right, floor @ up, color="0.9", zorder=0)
    if panel.ground is not None and panel.mesh.dimension == 2:
        ends = np.array([low[0], high[0]])
        for shape in shapes if panel.stacked else shapes[:1]:
            line = shape.level[1] + panel.ground * ends
            axis.fill_between(ends, line, line - 0.02 * (high[0] - low[0]), color="0.88", zorder=0, linewidth=0)
            axis.plot(ends, line, color=_GROUND_LINE, linewidth=1.2, zorder=1)
    for number, shape in enumerate(shapes):
        above = 2 + 3 * number
        axis.add_collection(
            PolyCollection(
                list(shape.polygons), facecolors=shape.colours, edgecolors=[shape.edges], linewidths=0.4, zorder=above
            )  # type: ignore[arg-type]
        )
        axis.add_collection(LineCollection(list(shape.skin), colors=[shape.outline], linewidths=1.0, zorder=above + 1))
        beside = panel.labelled is not None
        axis.annotate(
            shape.label,
            (shape.corner[0], shape.corner[1]),
            (4, 0) if beside else (0, 2),
            textcoords="offset points",
            ha="left" if beside else "center",
            va="center" if beside else "bottom",
            fontsize=7,
            color="0.3",
            zorder=100,
        )
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set_title(panel.title, fontsize=10)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=7)
    axis.set_xlabel("m", fontsize=8)
    if panel.stacked:
        axis.set_yticks([])
        axis.spines["left"].set_visible(False)


def _view(dimension: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors to the right, away and up of the picture."""
    if dimension == 2:
        return np.array([1.0, 0.0]), np.zeros(2), np.array([0.0, 1.0])
    right = np.array([np.cos(_TURN), np.sin(_TURN), 0.0])
    away = np.array([-np.sin(_TURN) * np.cos(_TILT), np.cos(_TURN) * np.cos(_TILT), -np.sin(_TILT)])
    return right, away, np.cross(right, away)


def _aspect(extent: np.ndarray) -> float:
    width, height = extent[1] - extent[0]
    return height / width


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    return figure
