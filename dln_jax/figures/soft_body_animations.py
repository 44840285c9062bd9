"""Animated GIFs of soft bodies: triangles in the plane, or the skin of a body in space seen obliquely from above."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dln_jax.figures import style
from dln_jax.figures.animations import DPI, write_gif
from dln_jax.figures.soft_body_drawing import EDGE, GROUND, GROUND_LINE, SKIN, drawn, flattened, floor
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError, require_positive

_ACTUATION = LinearSegmentedColormap.from_list("actuation", ["#c1121f", "#e9806e", "#d9d2c9"])
_ACTUATED = Normalize(0.25, 1)


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
    """Writes a motion with the outline of its first frame, the ground, axes in m, and the time.

    Args:
        path: path of the GIF.
        mesh: mesh to draw; in space only its skin, with axis 2 pointing up.
        positions: positions of the vertices, m.
        t: time of every frame, s.
        muscles: pairs of vertices [k, 2], drawn as lines (in the plane).
        actuation: length of the muscles in every frame relative to their rest length; red is short.
        ground: height of the ground, m; `None` draws none.
        title: title above the drawing.
        stride: frames of the motion per frame of the GIF.
        frames_per_second: frame rate of the GIF.

    Raises:
        InputError: times, vertices or muscles that do not fit the positions, or no frame.
    """
    require_positive(stride=stride, frames_per_second=frames_per_second)
    _require_fitting(mesh, positions, t, muscles, actuation)
    figure, show = _prepared(mesh, np.asarray(positions), muscles, actuation, ground)
    frames = range(0, len(t), stride)
    write_gif(path, figure, show, t, frames=frames, frames_per_second=frames_per_second, title=title)


def soft_body_frame(
    mesh: Mesh,
    positions: Float[np.ndarray, "n dim"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, " k"] | None = None,
    ground: float | None = 0.0,
) -> Figure:
    """One frame of `write_soft_body_gif` as a figure."""
    state = np.asarray(positions)[None]
    driven = None if actuation is None else np.asarray(actuation)[None]
    _require_fitting(mesh, state, np.zeros(1), muscles, driven)
    figure, show = _prepared(mesh, state, muscles, driven, ground)
    show(0)
    return figure


def _prepared(
    mesh: Mesh, positions: np.ndarray, muscles: Any, actuation: np.ndarray | None, ground: float | None
) -> tuple[Figure, Callable[[int], None]]:
    """The empty figure, and the function that draws a frame into it."""
    skin, seen, plane = boundary(mesh), flattened(positions), mesh.dimension == 2
    below = None if plane or ground is None else floor(positions, ground)
    figure, axis = _axes(seen if below is None else np.concatenate([seen.reshape(-1, 2), below]), plane, ground)
    if below is not None:
        axis.fill(*below.T, color=GROUND, zorder=0)
    if plane:
        axis.add_collection(LineCollection(list(seen[0][skin]), colors="0.8", linewidths=1.0, zorder=1))
    width, edge = (0.6, EDGE) if plane else (0.4, SKIN)
    body = PolyCollection([], edgecolors=[tuple(edge)], linewidths=width, zorder=2)
    outline = LineCollection([], colors=[tuple(SKIN)], linewidths=1.2, zorder=3, capstyle="round")
    lines = LineCollection([], linewidths=3.0, zorder=4, capstyle="round", cmap=_ACTUATION, norm=_ACTUATED)
    for collection in (body, outline, lines):
        axis.add_collection(collection)
    pairs = np.asarray(muscles) if plane and muscles is not None else np.zeros((0, 2), int)
    if len(pairs) and actuation is not None:
        bar = figure.colorbar(ScalarMappable(_ACTUATED, _ACTUATION), ax=axis, shrink=0.8, aspect=10, pad=0.01)
        bar.set_ticks([0.25, 1])
        bar.ax.tick_params(labelsize=style.SMALL)
        bar.set_label("muscle length / rest length", fontsize=style.SMALL)

    def show(frame: int) -> None:
        picture = drawn(mesh, skin, positions[frame])
        body.set_verts(list(picture.polygons))
        colours: Any = picture.colours
        body.set_facecolor(colours)
        if plane:
            outline.set_segments(list(seen[frame][skin]))
            lines.set_segments(list(seen[frame][pairs]))
            lines.set_array(np.full(len(pairs), 1.0) if actuation is None else np.asarray(actuation[frame]))

    return figure, show


def _axes(points: np.ndarray, plane: bool, ground: float | None) -> tuple[Figure, Axes]:
    """Axes of equal scale that contain all frames."""
    flat = points.reshape(-1, 2)
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    if plane and ground is not None:
        low[1] = min(low[1], ground)
    margin = 0.06 * max(high - low)
    low, high = low - margin, high + margin
    height = float(np.clip(style.WIDTH * (high[1] - low[1]) / (high[0] - low[0]), 0.9, 5.4))
    figure, [[axis]] = style.figure(height=height + 1.2, dpi=DPI)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x, m" if plane else "m", ylabel="y, m" if plane else "m")
    axis.grid(False)
    axis.yaxis.set_major_locator(MaxNLocator(4))
    if plane and ground is not None:
        axis.axhspan(low[1], ground, color=GROUND, zorder=0)
        axis.axhline(ground, color=GROUND_LINE, linewidth=1.2, zorder=1)
    return figure, axis


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
