"""Figures of soft bodies in motion: energies over time, snapshots and animated GIFs.

Bodies in the plane are drawn as triangles, those in space by their skin, seen obliquely from above.
"""

from collections.abc import Callable, Mapping, Sequence
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
from dln_jax.metrics.soft_body_energies import KINETIC, TOTAL
from dln_jax.softbody.mesh.mesh import Mesh, boundary
from dln_jax.types import InputError

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


def moments_figure(panels: Sequence[Moments], *, columns: int = 2) -> Figure:
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
    shapes = [np.divide(*(high - low)[::-1]) for _, low, high in places]
    shapes = [max(shapes[i] * len(row) / columns for i in row) for row in rows]
    width = style.WIDTH
    if columns == 1:
        width = min(width, max(_HIGHEST / shapes[0] + 0.6, 0.09 * len(panels[0].title)))
    heights = [np.clip(width / columns * shape, 1.2, _HIGHEST) + 0.55 for shape in shapes]
    figure = style.blank(height=sum(heights), width=width)
    grid = figure.add_gridspec(len(rows), columns, height_ratios=heights)
    for number, row in enumerate(rows):
        for column, i in enumerate(row):
            axis = figure.add_subplot(grid[number, column : columns if i == row[-1] else column + 1])
            style.prepare(axis)
            _draw(axis, panels[i], *places[i])
    return figure


def _fitting(name: str, positions: np.ndarray, mesh: Mesh) -> np.ndarray:
    positions = np.asarray(positions)
    if positions.shape[1:] != mesh.vertices.shape or not len(positions):
        vertices, dimension = mesh.vertices.shape
        raise InputError(f"{name} have shape {list(positions.shape)}; expected [T, {vertices}, {dimension}], T > 0")
    return positions


def _place(panel: Moments) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns by how much snapshots are lowered [k], and the lower left and the upper right corner of the panel."""
    positions = _fitting(f"positions of '{panel.title}'", panel.positions, panel.mesh)
    if len(panel.t) != len(positions):
        raise InputError(f"'{panel.title}' has {len(panel.t)} times for {len(positions)} snapshots; expected as many")
    flat = flattened(positions)
    drops = 1.4 * float(np.ptp(flat[..., 1], axis=1).max()) * panel.stacked * np.arange(len(flat))
    points = _lowered(flat, drops)
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    if panel.ground is not None and not panel.stacked:
        low[1] = min(low[1], panel.ground * low[0])
    margin = 0.05 * float((high - low).max())
    # Margins leave room for the times.
    below, above = ([1.0, 1.5], [1.0, 3.0]) if panel.stacked else ([4.0, 1.5], [3.0, 3.0])
    return drops, low - margin * np.array(below), high + margin * np.array(above)


def _lowered(points: np.ndarray, drops: Any) -> np.ndarray:
    return points - np.multiply.outer(drops, [0.0, 1.0])[..., None, :]


def _draw(axis: Axes, panel: Moments, drops: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    positions, mesh, count = np.asarray(panel.positions), panel.mesh, len(drops)
    flat = _lowered(flattened(positions), drops)
    ground = np.zeros((0, 2))
    if panel.ground is not None and mesh.dimension == 2:
        ground = straight_ground(np.linspace(low[0], high[0], 100), 0.0, panel.ground)
        for drop in np.unique(drops):
            draw_ground(axis, _lowered(ground, drop), depth=0.02 * (high[0] - low[0]))
    elif panel.ground == 0.0:
        axis.fill(*floor(positions, 0.0).T, color=GROUND, zorder=0)
    skin = np.unique(boundary(mesh))
    for number, (x, points, t) in enumerate(zip(positions, flat, panel.t, strict=True)):
        pale = 0.0 if panel.stacked else _FADED * (1.0 - number / max(count - 1, 1))
        add_body(axis, mesh, pale=pale, zorder=2 + 3 * number)(x, drops[number])
        corner, side = np.array([points[:, 0].mean(), points[:, 1].max()]), np.array([0.0, 1.0])
        if not panel.stacked and count > 1:
            # The time is placed at the skin vertex that is farthest from the ground and the other snapshots.
            others = np.concatenate([ground, *np.delete(flat, number, axis=0)])
            room = np.linalg.norm(points[skin][:, None] - others, axis=-1).min(axis=1)
            corner = points[skin][room.argmax()]
            side = (corner - points.mean(axis=0)) / np.linalg.norm(np.ptp(points, axis=0))
            side[0] -= 0.5 * (panel.ground or 0.0)  # away from sloping ground
        i, j = np.sign(np.round(3 * side)).astype(int).tolist()
        align = {"ha": ("center", "left", "right")[i], "va": ("center", "bottom", "top")[j]}
        look = {"fontsize": 7.5, "color": "0.25", "zorder": 100, **align}
        axis.annotate(f"{t:.2f} s", corner.tolist(), (4.0 * i, 4.0 * j), textcoords="offset points", **look)
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
    """Adds a body to axes; returns the function (positions [n, dim], drop) that draws it, lowered by `drop`.

    In the plane its triangles are drawn; in space the lit faces of its skin that face the viewer, the farthest first.
    `pale` is the share of white in its colours.
    """
    skin, plane = boundary(mesh), mesh.dimension == 2
    fade = lambda colour: colour + (1.0 - colour) * pale  # noqa: E731
    body = PolyCollection([], edgecolors=[tuple(fade(EDGE if plane else SKIN))], linewidths=0.5, zorder=zorder)
    outline = LineCollection([], colors=[tuple(fade(SKIN))], linewidths=1.1, zorder=zorder + 1, capstyle="round")
    axis.add_collection(body)
    axis.add_collection(outline)

    def show(x: np.ndarray, drop: float = 0.0) -> None:
        points, faces, light = _lowered(flattened(x), drop), mesh.elements, np.ones(1)
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


def straight_ground(x: np.ndarray, level: float, slope: float) -> Float[np.ndarray, "g 2"]:
    """Returns the points of the line y = level + slope x."""
    return np.stack([x, level + slope * x], axis=1)


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


def soft_body_drawing(
    mesh: Mesh,
    positions: Float[np.ndarray, "T n dim"],
    *,
    muscles: Any = None,
    actuation: Float[np.ndarray, "T k"] | None = None,
    ground: float | np.ndarray | None = 0.0,
    slope: float = 0.0,
) -> tuple[Figure, Callable[[int], None]]:
    """Returns a figure with axes that hold all frames, and the function that draws a frame in it, for `write_gif`.

    The figure shows the ground, and in the plane the outline of the first frame.

    Args:
        mesh: mesh to draw; in space only its skin, with axis 2 pointing up.
        positions: positions of the vertices, m.
        muscles: pairs of vertices [k, 2], drawn as lines (in the plane).
        actuation: length of the muscles in every frame relative to their rest length; red is short.
        ground: height of the ground at x = 0, m, or in the plane the points [g, 2] of its line; `None` for none.
        slope: slope of the ground (in the plane).

    Raises:
        InputError: vertices or muscles do not fit the positions, or there is no frame.
    """
    positions = _fitting("positions", positions, mesh)
    pairs = np.zeros((0, 2), int) if muscles is None else np.asarray(muscles)
    expected = (len(positions), len(pairs))
    lengths = np.ones(expected) if actuation is None else np.asarray(actuation)
    if lengths.shape != expected:
        raise InputError(f"actuation has shape {list(lengths.shape)}; expected {list(expected)}")
    points, plane = flattened(positions), mesh.dimension == 2
    below = floor(positions, ground) if isinstance(ground, int | float) and not plane else np.zeros((0, 2))
    every = np.concatenate([points.reshape(-1, 2), below])
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    margin = 0.06 * max(high - low)
    ends = np.array([low[0] - margin, high[0] + margin])
    if plane and ground is not None:
        below = ground if isinstance(ground, np.ndarray) else straight_ground(ends, ground, slope)
        low[1] = min(low[1], below[:, 1].min())
    bottom, top = low[1] - margin, high[1] + margin
    wide, high = np.ptp(ends), top - bottom
    figure, [[axis]] = style.figure(
        height=float(np.clip(style.WIDTH * high / wide, 0.9, 5.4)) + 1.2, dpi=style.FILM_DPI
    )
    axis.set(xlim=ends, ylim=(bottom, top), aspect="equal")
    axis.set(xlabel="x, m" if plane else "m", ylabel="y, m" if plane else "m")
    axis.grid(False)
    axis.yaxis.set_major_locator(MaxNLocator(4))
    if plane:
        if ground is not None:
            draw_ground(axis, below, depth=wide + high)
        axis.add_collection(LineCollection(list(points[0][boundary(mesh)]), colors="0.8", linewidths=1.0, zorder=1))
    else:
        axis.fill(*below.T, color=GROUND, zorder=0)
    show_body = add_body(axis, mesh)
    lines = LineCollection([], linewidths=3.0, zorder=4, capstyle="round", cmap=_ACTUATION, norm=_ACTUATED)
    axis.add_collection(lines)
    drawn = plane and len(pairs) > 0
    if drawn and actuation is not None:
        bar = figure.colorbar(ScalarMappable(_ACTUATED, _ACTUATION), ax=axis, shrink=0.8, aspect=10, pad=0.01)
        bar.set_ticks([0.25, 1])
        bar.ax.tick_params(labelsize=style.SMALL)
        bar.set_label("muscle length / rest length", fontsize=style.SMALL)

    def show(frame: int) -> None:
        show_body(positions[frame])
        if drawn:
            lines.set_segments(list(points[frame][pairs]))
            lines.set_array(lengths[frame])

    return figure, show
