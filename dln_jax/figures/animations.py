"""Animated GIFs of motions: pictures of several systems side by side, orbits, and the phase plane."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dln_jax.figures.gifs import DPI, write_gif
from dln_jax.figures.phase_space import COLOURS, TRUTH, plane_paths
from dln_jax.metrics.phase_space import Motions
from dln_jax.types import InputError, require_positive


def write_frame_gif(
    path: Path,
    frames: Mapping[str, Float[np.ndarray, "T pixels"]],
    t: Float[np.ndarray, " times"],
    *,
    frames_per_second: float = 20.0,
) -> None:
    """Writes square pictures of systems side by side, with their names and the time.

    Args:
        path: of the GIF.
        frames: of each system, intensities in [0, 1], row by row; what lies outside is drawn as the nearest.
        t: time of each frame in s.
        frames_per_second: with which they are shown.

    Raises:
        InputError: no system, or pictures that are not square or not as many as times.
    """
    require_positive(frames_per_second=frames_per_second)
    _require_common_length(t, {name: pictures.shape[0] for name, pictures in frames.items()})
    side = _side(next(iter(frames.values())).shape[1])
    figure = _figure(2.0 * len(frames), 2.7)
    images = []
    for axis, (name, pictures) in zip(_panels(figure, len(frames)), frames.items(), strict=True):
        axis.set_title(name, color=COLOURS.get(name, "C0"), fontsize=11)
        axis.set(xticks=[], yticks=[])
        images.append(axis.imshow(pictures[0].reshape(side, side), cmap="gray", vmin=0.0, vmax=1.0))

    def show(index: int) -> None:
        for image, pictures in zip(images, frames.values(), strict=True):
            image.set_data(pictures[index].reshape(side, side))

    _write(figure, path, t, show, frames_per_second)


def write_motion_gif(
    path: Path,
    motions: Mapping[str, Motions],
    *,
    shown: int = 0,
    tail: int = 20,
    stride: int = 1,
    frames_per_second: float = 20.0,
) -> None:
    """Writes one motion as each system has it, a panel each, with the truth's in grey behind the others.

    With one coordinate a panel is the phase plane; with 2 n coordinates it shows n bodies in a plane.

    Args:
        path: of the GIF.
        motions: by name, at common times; "truth" among them is drawn behind the rest.
        shown: which motion.
        tail: samples that a body leaves behind it.
        stride: samples between two frames of the GIF.
        frames_per_second: with which they are shown.

    Raises:
        InputError: no motion, or motions of several lengths.
    """
    require_positive(tail=tail, stride=stride, frames_per_second=frames_per_second)
    t = next(iter(motions.values())).t if motions else np.zeros(0)
    _require_common_length(t, {name: moved.q.shape[1] for name, moved in motions.items()})
    curves = {name: plane_paths(moved, shown) for name, moved in motions.items()}
    plane = next(iter(motions.values())).q.shape[2] == 1
    framed = curves.get(TRUTH) or [curve for of_one in curves.values() for curve in of_one]
    corners = [1.2 * max(float(np.nanmax(np.abs(curve[half]))) for curve in framed) for half in range(2)]
    if not plane:
        corners = [max(corners)] * 2
    figure = _figure(2.9 * len(motions) + 0.3, 3.4)
    drawn: list[tuple[Artist, Artist, tuple[np.ndarray, np.ndarray]]] = []
    for axis, name in zip(_panels(figure, len(motions)), motions, strict=True):
        colour = COLOURS.get(name, "C0")
        axis.set(xlim=(-corners[0], corners[0]), ylim=(-corners[1], corners[1]), box_aspect=1)
        axis.set_title(name, color=colour, fontsize=11)
        axis.set_xlabel("q" if plane else "x, m")
        axis.set_ylabel("p" if plane else "y, m")
        behind = [] if name == TRUTH else [("0.75", curve) for curve in curves.get(TRUTH, [])]
        for shade, curve in [*behind, *((colour, curve) for curve in curves[name])]:
            (line,) = axis.plot([], [], color=shade, linewidth=1.4)
            (body,) = axis.plot([], [], "o", color=shade, markersize=6)
            drawn.append((line, body, curve))

    def show(index: int) -> None:
        for line, body, (x, y) in drawn:
            since = max(0, index - tail)
            line.set(data=(x[since : index + 1], y[since : index + 1]))
            body.set(data=(x[index : index + 1], y[index : index + 1]))

    _write(figure, path, t, show, frames_per_second, stride)


def _write(figure: Figure, path: Path, t, show, frames_per_second: float, stride: int = 1) -> None:
    clock = figure.suptitle("", fontsize=10, family="monospace")

    def show_with_time(index: int) -> None:
        show(index)
        clock.set_text(f"t = {t[index]:6.2f} s")

    write_gif(path, figure, show_with_time, frames=range(0, len(t), stride), frames_per_second=frames_per_second)


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    return figure


def _panels(figure: Figure, count: int) -> list[Axes]:
    return list(figure.subplots(1, count, squeeze=False)[0])


def _require_common_length(t: np.ndarray, lengths: dict[str, int]) -> None:
    if not lengths or len(t) == 0:
        raise InputError("there is no motion to show; give at least one system, with at least one sample")
    for name, length in lengths.items():
        if length != len(t):
            raise InputError(f"{name} has {length} samples for {len(t)} times; expected one for each")


def _side(pixels: int) -> int:
    side = round(np.sqrt(pixels))
    if side * side != pixels:
        raise InputError(f"pictures have {pixels} pixels; expected a square, row by row")
    return side
