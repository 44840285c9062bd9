"""Figures of soft bodies in motion: energies over time, snapshots and animated GIFs.

Bodies in the plane are drawn as triangles, those in space by their skin, seen obliquely from above.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

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
from dln_jax.metrics.soft_body_energies import KINETIC, TOTAL
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError, require_positive

COLOURS = {
    KINETIC: style.VERMILLION,
    "gravity": style.ORANGE,
    "elastic": style.BLUE,
    "ground": style.GREEN,
    "muscles": style.PURPLE,
    TOTAL: "black",
}
BODY, EDGE, SKIN = np.array((0.62, 0.75, 0.87)), np.array((0.46, 0.58, 0.71)), np.array((0.16, 0.26, 0.38))
GROUND, GROUND_LINE = "0.90", (0.35, 0.33, 0.30)
# View of bodies in space: a turn about the vertical, then a tilt, in rad; vectors right, away from the viewer, and up.
_TURN, _TILT = np.deg2rad(-55.0), np.deg2rad(22.0)
_RIGHT = np.array([np.cos(_TURN), np.sin(_TURN), 0.0])
_AWAY = np.array([-np.sin(_TURN) * np.cos(_TILT), np.cos(_TURN) * np.cos(_TILT), -np.sin(_TILT)])
_UP = np.cross(_RIGHT, _AWAY)
_LIGHT = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
_HIGHEST = 3.6
"""Largest height of a panel in inches."""
_FADED = 0.75
"""Fading of the earliest snapshot towards the background, as a share."""
_ACTUATION = LinearSegmentedColormap.from_list("actuation", ["#c1121f", "#e9806e", "#d9d2c9"])
_ACTUATED = Normalize(0.25, 1)


class Moments(NamedTuple):
    """Snapshots of one body, drawn in one panel."""

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


def energies_against_time(
    t: Float[np.ndarray, " T"], energies: Mapping[str, Float[np.ndarray, " T"]], *, taken: str | None = None, title: str
) -> Figure:
    """Energies from `motion_energies` over time; gravity and total are relative to the initial gravitational energy.

    If nothing supplies energy, `taken` names what dissipates it, and the loss since the start is shaded.
    """
    power, unit = style.prefixed(max(float(np.abs(values - values[0]).max()) for values in energies.values()), "J")
    start = energies["gravity"][0] if "gravity" in energies else 0.0
    figure, [[axis]] = style.figure(height=3.4)
    for name, values in energies.items():
        line = (values - (start if name in ("gravity", TOTAL) else 0.0)) / power
        label = "gravity (from start)" if name == "gravity" else name
        # The total is drawn wider and behind, so that a curve coinciding with it stays visible.
        width, order = (3.0, 1.9) if name == TOTAL else (1.4, 2.0)
        axis.plot(t, line, color=COLOURS.get(name, "0.4"), linewidth=width, label=label, zorder=order)
    if taken is not None:
        total = (energies[TOTAL] - start) / power
        axis.fill_between(t, total, total[0], color="0.87", linewidth=0, zorder=0, label=taken)
    axis.set(xlabel="t, s", ylabel=f"energy, {unit}", xlim=(t[0], t[-1]))
    style.title(axis, title)
    style.legend_beside(figure, axis, columns=1, place="outside right upper")
    return figure


def moments_figure(panels: Sequence[Moments], *, columns: int = 2, width: float = style.WIDTH) -> Figure:
    """Snapshots of bodies with their times, one panel per body, earlier ones paler.

    Raises:
        InputError: there is no panel, or positions, times and mesh of a panel do not fit.
    """
    if not panels:
        raise InputError("there is no panel; give at least one")
    places = [_place(panel) for panel in panels]
    columns = min(columns, len(panels))
    rows = [range(i, min(i + columns, len(panels))) for i in range(0, len(panels), columns)]
    # The last panel fills the rest of its row, and a row is as high as its highest panel.
    shapes = [max(np.divide(*(places[i].high - places[i].low)[::-1]) * len(row) / columns for i in row) for row in rows]
    if columns == 1:
        width = min(width, max(_HIGHEST / shapes[0] + 0.6, 0.09 * len(panels[0].title)))
    heights = [np.clip(width / columns * shape, 1.2, _HIGHEST) + 0.55 for shape in shapes]
    figure = style.blank(height=sum(heights), width=width)
    grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
    for number, row in enumerate(rows):
        for column, i in enumerate(row):
            axis = figure.add_subplot(grid[number, column : columns if i == row[-1] else column + 1])
            style.prepare(axis)
            _draw(axis, panels[i], places[i])
    return figure


class _Place(NamedTuple):
    offsets: np.ndarray
    """Offset of every snapshot [k, 2]."""
    points: np.ndarray
    """Vertices in the drawing plane [k, n, 2]."""
    low: np.ndarray
    high: np.ndarray
    """Corners of the panel."""


def _place(panel: Moments) -> _Place:
    positions = np.asarray(panel.positions)
    if positions.ndim != 3 or positions.shape[1:] != panel.mesh.vertices.shape or len(positions) != len(panel.t):
        raise InputError(
            f"'{panel.title}' has positions {list(positions.shape)} at {len(panel.t)} times; "
            f"expected [k, {panel.mesh.vertices.shape[0]}, {panel.mesh.dimension}] at k"
        )
    flat = flattened(positions)
    pitch = 1.4 * float(np.ptp(flat[..., 1], axis=1).max()) * panel.stacked
    offsets = -pitch * np.arange(len(flat))[:, None] * np.array([0.0, 1.0])
    points = flat + offsets[:, None]
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    if panel.ground is not None and not panel.stacked:
        low[1] = min(low[1], panel.ground * low[0])
    margin = 0.05 * float((high - low).max())
    # Margins leave room for the times.
    sides = np.array([1.0 if panel.stacked else 4.0, 1.5]), np.array([1.0 if panel.stacked else 3.0, 3.0])
    return _Place(offsets, points, low - margin * sides[0], high + margin * sides[1])


def _draw(axis: Axes, panel: Moments, place: _Place) -> None:
    low, high = place.low, place.high
    plane, count = panel.mesh.dimension == 2, len(place.points)
    levels = place.offsets[:, 1] if panel.stacked else np.zeros(1)
    ground = np.zeros((0, 2))
    if panel.ground is not None and plane:
        along = np.linspace(low[0], high[0], 100)
        ground = np.stack([along, panel.ground * along], axis=-1)
        for level in levels:
            line = straight_ground((low[0], high[0]), level, panel.ground)
            draw_ground(axis, line, depth=0.02 * (high[0] - low[0]))
    elif panel.ground == 0.0:
        axis.fill(*floor(np.asarray(panel.positions), 0.0).T, color=GROUND, zorder=0)
    for number, x in enumerate(np.asarray(panel.positions)):
        pale = 0.0 if panel.stacked else _FADED * (1.0 - number / max(count - 1, 1))
        add_body(axis, panel.mesh, pale=pale, zorder=2 + 3 * number)(x, place.offsets[number])
    skin = np.unique(boundary(panel.mesh))
    for number, (points, t) in enumerate(zip(place.points, panel.t, strict=True)):
        corner, side = np.array([points[:, 0].mean(), points[:, 1].max()]), np.array([0.0, 1.0])
        if not panel.stacked and count > 1:
            # The time is placed at the skin vertex that is farthest from the ground and the other snapshots.
            others = np.concatenate([ground, *np.delete(place.points, number, axis=0)])
            room = np.linalg.norm(points[skin][:, None] - others, axis=-1).min(axis=1)
            corner = points[skin][room.argmax()]
            side = (corner - points.mean(axis=0)) / np.linalg.norm(np.ptp(points, axis=0))
            side[0] -= 0.5 * (panel.ground or 0.0)  # away from sloping ground
        (x, y), (i, j) = corner.tolist(), np.sign(np.round(3 * side)).astype(int).tolist()
        align = {"ha": ("center", "left", "right")[i], "va": ("center", "bottom", "top")[j]}
        look = {"fontsize": 7.5, "color": "0.25", "zorder": 100, **align}
        axis.annotate(f"{t:.2f} s", (x, y), (4.0 * i, 4.0 * j), textcoords="offset points", **look)
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


def add_body(axis: Axes, mesh: Mesh, *, pale: float = 0.0, zorder: int = 2) -> Callable[..., None]:
    """Adds a body to axes; returns the function (positions [n, dim], offset [2]) that draws it.

    In the plane its triangles are drawn; in space the lit faces of its skin that face the viewer, the farthest first.
    `pale` is the share of white in its colours.
    """
    skin, plane = boundary(mesh), mesh.dimension == 2
    fade = lambda colour: colour + (1.0 - colour) * pale  # noqa: E731
    body = PolyCollection([], edgecolors=[tuple(fade(EDGE if plane else SKIN))], linewidths=0.5, zorder=zorder)
    outline = LineCollection([], colors=[tuple(fade(SKIN))], linewidths=1.1, zorder=zorder + 1, capstyle="round")
    axis.add_collection(body)
    axis.add_collection(outline)

    def show(x: np.ndarray, offset: np.ndarray | float = 0.0) -> None:
        points, faces, light = flattened(x) + offset, mesh.elements, np.ones(1)
        if plane:
            outline.set_segments(list(points[skin]))
        else:
            corners = x[skin]
            normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
            order = np.argsort(-(corners @ _AWAY).mean(axis=1))
            order = order[(normal @ _AWAY)[order] < 0]
            faces, light = skin[order], (0.8 + 0.2 * (normal @ _LIGHT))[order]
        body.set_verts(list(points[faces]))
        body.set_facecolor(list(map(tuple, fade(np.clip(light[:, None] * BODY, 0.0, 1.0)))))

    return show


def straight_ground(ends: tuple[float, float], level: float, slope: float) -> Float[np.ndarray, "2 2"]:
    """Returns the line y = level + slope x between two values of x."""
    return np.stack([np.array(ends), level + slope * np.array(ends)], axis=1)


def draw_ground(axis: Axes, line: Float[np.ndarray, "g 2"], *, depth: float) -> None:
    """Draws the ground in the plane below a line, as a strip of this depth."""
    x, y = line.T
    axis.fill_between(x, y, y - depth, color=GROUND, zorder=0, linewidth=0)
    axis.plot(x, y, color=GROUND_LINE, linewidth=1.2, zorder=1)


def floor(positions: Float[np.ndarray, "*k 3"], height: float) -> Float[np.ndarray, "4 2"]:
    """Returns the rectangle at this height below all positions, in the drawing plane."""
    flat = positions[..., :2].reshape(-1, 2)
    (west, south), (east, north) = flat.min(axis=0), flat.max(axis=0)
    corners = [[west, south, height], [east, south, height], [east, north, height], [west, north, height]]
    return flattened(np.array(corners))


def flattened(positions: Float[np.ndarray, "*k dim"]) -> Float[np.ndarray, "*k 2"]:
    """Projects positions onto the drawing plane."""
    return positions if positions.shape[-1] == 2 else np.stack([positions @ _RIGHT, positions @ _UP], axis=-1)


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
    options = {"muscles": muscles, "actuation": actuation, "ground": ground, "slope": slope}
    figure, show = soft_body_drawing(mesh, positions, **options)
    frames = range(0, len(t), stride)
    write_gif(path, figure, show, t, frames=frames, frames_per_second=frames_per_second, title=title)


def soft_body_drawing(
    mesh: Mesh,
    positions: Float[np.ndarray, "T n dim"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, "T k"] | None = None,
    ground: float | np.ndarray | None = 0.0,
    slope: float = 0.0,
) -> tuple[Figure, Callable[[int], None]]:
    """Returns a figure with the ground and axes that hold all frames, and the function that draws a frame in it.

    Arguments are those of `write_soft_body_gif`.

    Raises:
        InputError: vertices or muscles do not fit the positions, or there is no frame.
    """
    positions = np.asarray(positions)
    shape = mesh.vertices.shape
    if positions.ndim != 3 or positions.shape[1:] != shape or len(positions) == 0:
        raise InputError(f"positions have shape {list(positions.shape)}; expected [T, {shape[0]}, {shape[1]}], T > 0")
    expected = (len(positions), 0 if muscles is None else len(muscles))
    if actuation is not None and np.shape(actuation) != expected:
        raise InputError(f"actuation has shape {list(np.shape(actuation))}; expected {list(expected)}")
    points, plane = flattened(positions), mesh.dimension == 2
    below = floor(positions, ground) if isinstance(ground, int | float) and not plane else np.zeros((0, 2))
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
