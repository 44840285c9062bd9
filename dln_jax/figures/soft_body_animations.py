"""Animated GIFs of soft bodies: triangles of the plane, or the skin of a body in space, seen from above at an angle."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dln_jax.figures.gifs import DPI, write_gif
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError, require_positive

_WIDTH = 8.0
_BODY, _EDGE, _SKIN, _GROUND = (0.62, 0.75, 0.87), (0.46, 0.58, 0.71), (0.16, 0.26, 0.38), (0.35, 0.33, 0.30)
_ACTUATION = LinearSegmentedColormap.from_list("actuation", ["#c1121f", "#e9806e", "#d9d2c9"])
# Direction of view in space: turned about the vertical axis, then tilted; radians.
_TURN, _TILT = np.deg2rad(-55.0), np.deg2rad(22.0)


def write_soft_body_gif(
    path: Path,
    mesh: Mesh,
    positions: Float[np.ndarray, "T n dim"],
    t: Float[np.ndarray, " times"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, "times k"] | None = None,
    ground: float | None = 0.0,
    title: str = "",
    stride: int = 1,
    frames_per_second: float = 15.0,
) -> None:
    """Writes a motion with the outline of its first frame, the ground, metres and the time.

    Args:
        path: of the GIF.
        mesh: whose elements are drawn; in space only its skin is, and axis 2 points up.
        positions: of the vertices in m.
        t: time of each frame in s.
        muscles: pairs of vertices [k, 2], drawn as lines (in the plane).
        actuation: of the muscles in each frame, relative to their rest length: red is short.
        ground: height of the ground in m; `None` draws none.
        title: text above the picture.
        stride: frames of the motion between two of the GIF.
        frames_per_second: with which they are shown.

    Raises:
        InputError: times, vertices or muscles that do not fit the positions, or no frame.
    """
    require_positive(stride=stride, frames_per_second=frames_per_second)
    _require_fitting(mesh, positions, t, muscles, actuation)
    draw = _draw_plane if mesh.dimension == 2 else _draw_space
    figure, show = draw(mesh, np.asarray(positions), muscles, actuation, ground)
    heading = figure.suptitle("", fontsize=10, family="monospace")

    def show_with_time(frame: int) -> None:
        show(frame)
        heading.set_text(f"{title}  t = {t[frame]:5.2f} s".strip())

    write_gif(path, figure, show_with_time, frames=range(0, len(t), stride), frames_per_second=frames_per_second)


def soft_body_frame(
    mesh: Mesh,
    positions: Float[np.ndarray, "n dim"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, " k"] | None = None,
    ground: float | None = 0.0,
) -> Figure:
    """One frame of `write_soft_body_gif`, as a figure."""
    state = np.asarray(positions)[None]
    driven = None if actuation is None else np.asarray(actuation)[None]
    _require_fitting(mesh, state, np.zeros(1), muscles, driven)
    draw = _draw_plane if mesh.dimension == 2 else _draw_space
    figure, show = draw(mesh, state, muscles, driven, ground)
    show(0)
    return figure


def _draw_plane(mesh: Mesh, positions: np.ndarray, muscles: Any, actuation: np.ndarray | None, ground: float | None):
    figure, axis = _axes(positions, ground)
    skin = boundary(mesh)
    axis.add_collection(LineCollection(positions[0][skin], colors="0.8", linewidths=1.0, zorder=1))
    body = PolyCollection([], facecolors=[_BODY], edgecolors=[_EDGE], linewidths=0.6, zorder=2)
    outline = LineCollection([], colors=[_SKIN], linewidths=1.2, zorder=3, capstyle="round")
    axis.add_collection(body)
    axis.add_collection(outline)
    pairs, lines = np.zeros((0, 2), int), None
    if muscles is not None:
        pairs = np.asarray(muscles)
        lines = LineCollection([], linewidths=3.0, zorder=4, capstyle="round", cmap=_ACTUATION, norm=Normalize(0.25, 1))
        axis.add_collection(lines)
        if actuation is not None:
            _colour_bar(figure, axis, _ACTUATION)

    def show(frame: int) -> None:
        x = positions[frame]
        body.set_verts(x[mesh.elements])
        outline.set_segments(list(x[skin]))
        if lines is not None:
            lines.set_segments(list(x[pairs]))
            lines.set_array(np.full(len(pairs), 1.0) if actuation is None else np.asarray(actuation[frame]))

    return figure, show


def _draw_space(mesh: Mesh, positions: np.ndarray, muscles: Any, actuation: np.ndarray | None, ground: float | None):
    del muscles, actuation
    skin = boundary(mesh)
    right = np.array([np.cos(_TURN), np.sin(_TURN), 0.0])
    away = np.array([-np.sin(_TURN) * np.cos(_TILT), np.cos(_TURN) * np.cos(_TILT), -np.sin(_TILT)])
    up = np.cross(right, away)
    seen = np.stack([positions @ right, positions @ up], axis=-1)
    low, high = positions[..., :2].min((0, 1)), positions[..., :2].max((0, 1))
    corners = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    floor = np.column_stack([corners, np.full(4, ground or 0.0)]) @ np.stack([right, up], axis=1)
    figure, axis = _axes(seen.reshape(-1, 2) if ground is None else np.concatenate([seen.reshape(-1, 2), floor]), None)
    axis.set(xlabel="m", ylabel="m")
    if ground is not None:
        axis.fill(*floor.T, color="0.92", zorder=0)
    body = PolyCollection([], edgecolors=[_SKIN], linewidths=0.4, zorder=2)
    axis.add_collection(body)
    light = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])

    def show(frame: int) -> None:
        corners = positions[frame][skin]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1, keepdims=True)
        normal = normal / np.where(area > 0, area, 1.0)
        order = np.argsort(-(corners @ away).mean(axis=1))
        order = order[(normal @ away)[order] < 0]
        shade = (0.7 + 0.3 * (normal @ light))[order, None]
        body.set_verts(seen[frame][skin[order]])
        body.set_facecolor(np.clip(shade * np.array(_BODY), 0, 1))  # type: ignore[arg-type]

    return figure, show


def _axes(points: np.ndarray, ground: float | None) -> tuple[Figure, Axes]:
    """Equal scales on both axes, with everything in view from the first frame to the last."""
    flat = points.reshape(-1, 2)
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    if ground is not None:
        low[1] = min(low[1], ground)
    margin = 0.06 * max(high - low)
    low, high = low - margin, high + margin
    height = np.clip(_WIDTH * (high[1] - low[1]) / (high[0] - low[0]), 0.9, 6.0)
    figure = Figure(figsize=(_WIDTH, height + 1.3), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, m", ylabel="y, m")
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=8)
    axis.yaxis.set_major_locator(MaxNLocator(4))
    if ground is not None:
        axis.axhspan(low[1], ground, color="0.92", zorder=0)
        axis.axhline(ground, color=_GROUND, linewidth=1.2, zorder=1)
    return figure, axis


def _colour_bar(figure: Figure, axis: Axes, colours: Colormap) -> None:
    scale = ScalarMappable(Normalize(0.25, 1), colours)
    bar = figure.colorbar(scale, ax=axis, shrink=0.8, aspect=10, pad=0.01, ticks=[0.25, 1])
    bar.ax.tick_params(labelsize=8)
    bar.set_label("actuation", fontsize=8)


def _require_fitting(mesh: Mesh, positions: np.ndarray, t: np.ndarray, muscles: Any, actuation: Any) -> None:
    shape = mesh.vertices.shape
    if positions.ndim != 3 or positions.shape[1:] != shape or len(positions) == 0:
        raise InputError(f"positions have shape {list(positions.shape)}; expected [T, {shape[0]}, {shape[1]}], T > 0")
    if len(t) != len(positions):
        raise InputError(f"there are {len(t)} times for {len(positions)} frames; expected one for each")
    if actuation is not None:
        expected = (len(positions), 0 if muscles is None else len(muscles))
        if np.shape(actuation) != expected:
            raise InputError(f"actuation has shape {list(np.shape(actuation))}; expected {list(expected)}")
