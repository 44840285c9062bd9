"""Animated GIFs of soft bodies: triangles in the plane, or the skin of a body in space seen obliquely from above."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from dln_jax.figures import style
from dln_jax.figures.animations import DPI, write_gif
from dln_jax.figures.soft_bodies import GROUND, add_body, draw_ground, flattened, floor, straight_ground
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
    ground: float | np.ndarray | None = 0.0,
    slope: float = 0.0,
    title: str = "",
    stride: int = 1,
    frames_per_second: float = 15.0,
) -> None:
    """Writes a motion with the outline of its first frame, the ground, axes in m, and the time.

    Args:
        mesh: mesh to draw; in space only its skin, with axis 2 pointing up.
        positions: positions of the vertices, m.
        t: time of every frame, s.
        muscles: pairs of vertices [k, 2], drawn as lines (in the plane).
        actuation: length of the muscles in every frame relative to their rest length; red is short.
        ground: height of the ground at x = 0, m, or in the plane the points [g, 2] of its line; `None` for none.
        slope: slope of the ground (in the plane).
        stride: frames of the motion per frame of the GIF.
        frames_per_second: frame rate of the GIF.

    Raises:
        InputError: times, vertices or muscles do not fit the positions, or there is no frame.
    """
    require_positive(stride=stride, frames_per_second=frames_per_second)
    if len(t) != len(positions):
        raise InputError(f"there are {len(t)} times for {len(positions)} frames; expected one for each")
    figure, show = _prepared(mesh, np.asarray(positions), muscles, actuation, ground, slope)
    frames = range(0, len(t), stride)
    write_gif(path, figure, show, t, frames=frames, frames_per_second=frames_per_second, title=title)


def soft_body_frame(
    mesh: Mesh,
    positions: Float[np.ndarray, "n dim"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, " k"] | None = None,
    ground: float | np.ndarray | None = 0.0,
    slope: float = 0.0,
) -> Figure:
    """Returns one frame of `write_soft_body_gif` as a figure."""
    lengths = None if actuation is None else np.asarray(actuation)[None]
    figure, show = _prepared(mesh, np.asarray(positions)[None], muscles, lengths, ground, slope)
    show(0)
    return figure


def _prepared(
    mesh: Mesh, positions: np.ndarray, muscles: Any, actuation: Any, ground: Any, slope: float
) -> tuple[Figure, Callable[[int], None]]:
    """Returns the figure with ground and equally scaled axes that hold all frames, and the function that draws one."""
    shape = mesh.vertices.shape
    if positions.ndim != 3 or positions.shape[1:] != shape or len(positions) == 0:
        raise InputError(f"positions have shape {list(positions.shape)}; expected [T, {shape[0]}, {shape[1]}], T > 0")
    expected = (len(positions), 0 if muscles is None else len(muscles))
    if actuation is not None and np.shape(actuation) != expected:
        raise InputError(f"actuation has shape {list(np.shape(actuation))}; expected {list(expected)}")
    points, plane = flattened(positions), mesh.dimension == 2
    below = floor(positions, ground) if ground is not None and not plane else np.zeros((0, 2))
    every = np.concatenate([points.reshape(-1, 2), below])
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    margin = 0.06 * max(high - low)
    low[0], high[0] = low[0] - margin, high[0] + margin
    line = np.zeros((0, 2))
    if plane and ground is not None:
        flat = not isinstance(ground, np.ndarray)
        line = straight_ground((low[0], high[0]), ground, slope) if flat else ground
        low[1] = min(low[1], line[:, 1].min())
    low[1], high[1] = low[1] - margin, high[1] + margin
    height = float(np.clip(style.WIDTH * (high[1] - low[1]) / (high[0] - low[0]), 0.9, 5.4))
    figure, [[axis]] = style.figure(height=height + 1.2, dpi=DPI)
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set(xlabel="x, m" if plane else "m", ylabel="y, m" if plane else "m")
    axis.grid(False)
    axis.yaxis.set_major_locator(MaxNLocator(4))
    if plane:
        if ground is not None:
            draw_ground(axis, line, depth=float(np.ptp([low, high], axis=0).sum()))
        axis.add_collection(LineCollection(list(points[0][boundary(mesh)]), colors="0.8", linewidths=1.0, zorder=1))
    elif ground is not None:
        axis.fill(*below.T, color=GROUND, zorder=0)
    show_body = add_body(axis, mesh)
    pairs = np.asarray(muscles) if plane and muscles is not None else np.zeros((0, 2), int)
    lines = LineCollection([], linewidths=3.0, zorder=4, capstyle="round", cmap=_ACTUATION, norm=_ACTUATED)
    axis.add_collection(lines)
    if len(pairs) and actuation is not None:
        bar = figure.colorbar(ScalarMappable(_ACTUATED, _ACTUATION), ax=axis, shrink=0.8, aspect=10, pad=0.01)
        bar.set_ticks([0.25, 1])
        bar.ax.tick_params(labelsize=style.SMALL)
        bar.set_label("muscle length / rest length", fontsize=style.SMALL)

    def show(frame: int) -> None:
        show_body(positions[frame])
        if len(pairs):
            lines.set_segments(list(points[frame][pairs]))
            lines.set_array(np.ones(len(pairs)) if actuation is None else np.asarray(actuation[frame]))

    return figure, show
