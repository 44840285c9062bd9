"""Films of bodies in the plane as lit slabs, seen from the right and above, with their shadows on the ground.

A point (x, y) at depth s behind the front is drawn at (x, y) + s OBLIQUE, so fronts keep their true shape.
"""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.figures.soft_bodies import BODY
from dln_jax.figures.style import FILM_DPI, write_gif
from dln_jax.softbody.mesh.mesh import Mesh, boundary, components
from dln_jax.types import InputError, require_positive

OBLIQUE = np.array([0.32, 0.40])
"""Shift in the drawing plane per unit of depth."""
TOOL = "0.42"
"""Colour of rigid bodies, such as a palm."""
_STONE = np.array([0.80, 0.78, 0.75])
_LIGHT = np.array([-0.35, 0.80, -0.49])  # to the right, upwards, away from the viewer
_PIECES = 24
_DARKEST = 0.38
"""Share of the light that a body standing on the ground takes away."""


class Slab(NamedTuple):
    """A rigid outline that moves with the bodies."""

    outline: Float[np.ndarray, "p 2"]
    """Corners in order, counter-clockwise, m."""
    colour: str | Sequence[float]


def write_slab_film(
    path: Path,
    mesh: Mesh,
    positions: Float[np.ndarray, "T n dim"],
    t: Float[np.ndarray, " times"],
    *,
    depth: float,
    ground: Float[np.ndarray, "g 2"],
    colours: Float[np.ndarray, "m 3"] | Callable[[int], Float[np.ndarray, "m 3"]] | None = None,
    slabs: Callable[[int], Sequence[Slab]] | None = None,
    label: Callable[[int], str] | None = None,
    window: tuple[tuple[float, float], tuple[float, float]] | None = None,
    width: float = style.WIDTH,
    stride: int = 1,
    frames_per_second: float = 20.0,
) -> None:
    """Writes a motion in the plane as a GIF, with a scale bar and the time.

    Args:
        mesh: mesh of all bodies, in the plane.
        positions: positions of the vertices, m.
        t: time of every frame, s.
        depth: depth of the bodies in the drawing, m.
        ground: points of the ground's surface, from left to right, m; vertical parts of it are walls.
        colours: colour of every element, or a function of the frame.
        slabs: function of the frame that returns rigid outlines.
        label: function of the frame that returns text next to the time.
        window: visible ranges of x and y, m; by default those of the ground and the motion.
        width: width of the film, inches.
        stride: frames of the motion per frame of the GIF.
        frames_per_second: frame rate of the GIF.

    Raises:
        InputError: the mesh is in space, or times do not fit the positions.
    """
    require_positive(depth=depth, stride=stride, frames_per_second=frames_per_second, width=width)
    x = np.asarray(positions)
    if mesh.dimension != 2 or x.ndim != 3 or x.shape[1:] != mesh.vertices.shape or len(x) != len(t) or len(t) == 0:
        expected = f"[T, {len(mesh.vertices)}, 2] at T times, T > 0, of a mesh in the plane"
        raise InputError(f"positions have shape {list(x.shape)} at {len(t)} times; expected {expected}")
    if window is None:
        every = np.concatenate([x.reshape(-1, 2), ground])
        low, high = every.min(axis=0), every.max(axis=0) + depth * OBLIQUE
        margin = 0.04 * float((high - low).max())
        window = (low[0] - margin, high[0] + margin), (low[1] - margin, high[1] + margin)
    (west, east), (south, north) = window
    figure = Figure(figsize=(width, width * (north - south) / (east - west) + 0.3), dpi=FILM_DPI)
    figure.subplots_adjust(0, 0, 1, 1 - 0.3 / figure.get_figheight())
    axis = figure.add_subplot()
    axis.set(xlim=window[0], ylim=window[1], aspect="equal")
    axis.set_axis_off()
    _draw_ground(axis, ground, depth, bottom=south)
    _draw_scale(axis, window)
    show = _bodies(axis, mesh, x, depth, ground, colours, slabs)
    text = axis.annotate("", (1, 1), (-8, 4), "axes fraction", textcoords="offset points", ha="right", va="bottom")
    text.set(fontsize=style.TEXT, color="0.25", annotation_clip=False)

    def frame(k: int) -> None:
        show(k)
        text.set_text(f"{label(k)}    {t[k]:.2f} s" if label else f"{t[k]:.2f} s")

    frames = range(0, len(t), stride)
    write_gif(path, figure, frame, None, frames=frames, frames_per_second=frames_per_second)


def _bodies(
    axis: Axes, mesh: Mesh, x: np.ndarray, depth: float, ground: np.ndarray, colours, slabs
) -> Callable[[int], None]:
    """Adds everything that moves, and returns the function that draws a frame."""
    rim, part = boundary(mesh), components(mesh)
    owners = _owners(mesh, rim)
    members = [np.unique(mesh.elements[part == number]) for number in range(part.max() + 1)]
    shadows = axis.add_collection(PolyCollection([], linewidths=0, zorder=3))
    sides = axis.add_collection(PolyCollection([], linewidths=0.4, zorder=4))
    fronts = axis.add_collection(PolyCollection([], linewidths=0.4, zorder=5))
    outlines = axis.add_collection(PolyCollection([], linewidths=0.8, facecolors="none", zorder=6))
    shift, lit_ground = depth * OBLIQUE, (_brightness(np.array([[0.0, 1.0, 0.0]])) * _STONE)[0]

    def show(k: int) -> None:
        at, rigid = x[k], slabs(k) if slabs else ()
        chosen = colours(k) if callable(colours) else BODY if colours is None else colours
        paint = np.broadcast_to(chosen, (len(part), 3))
        tools = [(np.asarray(slab.outline), np.array(to_rgb(slab.colour))) for slab in rigid]
        pieces = [_pieces(outline) for outline, _ in tools]
        edges = np.concatenate([at[rim], *pieces])
        of_edges = np.concatenate(
            [paint[owners], *(np.tile(c, (len(own), 1)) for own, (_, c) in zip(pieces, tools, strict=True))]
        )
        quads, lit = _side_faces(edges, of_edges, shift)
        sides.set(verts=quads, facecolor=lit, edgecolor=lit)
        flat = np.clip(_brightness(np.array([[0.0, 0.0, -1.0]])) * paint, 0, 1)
        shapes = [*(o for o, _ in tools), *at[mesh.elements]]
        fill = np.concatenate([*(colour[None] for _, colour in tools), flat])
        fronts.set(verts=shapes, facecolor=fill, edgecolor=0.88 * fill)
        rims = [*(o for o, _ in tools), *at[rim]]
        outlines.set(verts=rims, edgecolor=0.55 * np.concatenate([*(c[None] for _, c in tools), paint[owners]]))
        dark = [_shadow(at[own], ground, shift) for own in members] + [_shadow(o, ground, shift) for o, _ in tools]
        # The darkest one is drawn last, so that shadows do not add up.
        cast = [(quad, share) for quads, share in sorted(dark, key=lambda shadow: shadow[1]) for quad in quads]
        shadows.set(verts=[quad for quad, _ in cast])
        shadows.set_facecolor([tuple((1.0 - share) * lit_ground) for _, share in cast])

    return show


def _pieces(outline: np.ndarray) -> np.ndarray:
    """Cuts the sides of an outline into short pieces [k, 2, 2], so that their order in depth is right."""
    along = np.linspace(0.0, 1.0, _PIECES + 1)[None, :, None]
    points = (1 - along) * outline[:, None] + along * np.roll(outline, -1, axis=0)[:, None]
    return np.stack([points[:, :-1], points[:, 1:]], axis=2).reshape(-1, 2, 2)


def _side_faces(edges: np.ndarray, paint: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the faces behind edges that the viewer sees, the farthest first, and their lit colours."""
    along = edges[:, 1] - edges[:, 0]
    normal = np.stack([along[:, 1], -along[:, 0], np.zeros(len(along))], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    order = np.argsort(edges.mean(axis=1) @ shift)
    order = order[(normal[:, :2] @ shift)[order] > 0]
    quads = np.stack([edges[:, 0], edges[:, 1], edges[:, 1] + shift, edges[:, 0] + shift], axis=1)
    return quads[order], np.clip(_brightness(normal[order]) * paint[order], 0, 1)


def _brightness(normal: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 1"]:
    return 0.80 + 0.32 * (normal @ _LIGHT)[:, None]


def _shadow(x: np.ndarray, ground: np.ndarray, shift: np.ndarray) -> tuple[list[np.ndarray], float]:
    """Returns the parts of the ground straight below a body, and their darkness, which decreases with its height."""
    (west, bottom), east = x.min(axis=0), x[:, 0].max()
    size, quads, top = float(np.ptp(x, axis=0).max()), [], -np.inf
    for a, b in itertools.pairwise(ground):
        ends = np.clip([west, east], *sorted((a[0], b[0])))
        if ends[0] < ends[1]:
            line = np.stack([ends, np.interp(ends, [a[0], b[0]], [a[1], b[1]])], axis=1)
            quads.append(np.concatenate([line, line[::-1] + shift]))
            top = max(top, line[:, 1].max())
    return quads, _DARKEST / (1.0 + 2.0 * max(bottom - top, 0.0) / size) if quads else 0.0


def _draw_ground(axis: Axes, ground: np.ndarray, depth: float, *, bottom: float) -> None:
    shift = 1.35 * depth * OBLIQUE
    # The body of the ground is on the right of its line, which runs from left to right.
    quads, lit = _side_faces(np.stack([ground[1:], ground[:-1]], axis=1), np.tile(_STONE, (len(ground) - 1, 1)), shift)
    axis.add_collection(PolyCollection(list(quads), facecolors=lit, edgecolors=lit, linewidths=0.4, zorder=1))
    front = np.concatenate([ground, [[ground[-1, 0], bottom], [ground[0, 0], bottom]]])
    axis.add_collection(PolyCollection([front], facecolors=[0.84 * _STONE], edgecolors="none", zorder=7))
    axis.plot(*ground.T, color=0.6 * _STONE, linewidth=0.8, zorder=7)


def _draw_scale(axis: Axes, window: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Draws a bar of a round length, about a sixth of the width, on the front of the ground."""
    (west, east), (south, north) = window
    wanted = (east - west) / 6
    power = 10.0 ** np.floor(np.log10(wanted))
    length = power * max(k for k in (1, 2, 5) if k * power <= wanted)
    unit, name = style.prefixed(length, "m")
    x, y = west + 0.03 * (east - west), south + 0.03 * (north - south)
    axis.plot([x, x + length], [y, y], color="0.2", linewidth=2.5, solid_capstyle="butt", zorder=9)
    axis.text(x + length, y, f"  {length / unit:.0f} {name}", fontsize=style.SMALL, color="0.2", va="center", zorder=9)


def _owners(mesh: Mesh, rim: Int[np.ndarray, "f 2"]) -> Int[np.ndarray, " f"]:
    """Returns the element of every edge of the boundary."""
    sides = np.sort(mesh.elements[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    elements = {tuple(side): number // 3 for number, side in enumerate(sides.tolist())}
    return np.array([elements[tuple(edge)] for edge in np.sort(rim, axis=1).tolist()])
