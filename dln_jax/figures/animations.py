"""Animated GIFs, written frame by frame, and motions in the plane over the truth."""

import io
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from dln_jax.figures import style
from dln_jax.figures.phase_space import plane_paths
from dln_jax.figures.style import TRUTH
from dln_jax.files import write_bytes
from dln_jax.metrics.phase_space import Motions
from dln_jax.types import InputError, require_positive

DPI, COLOURS = 100, 128
"""Pixels per inch, and number of colours of a GIF."""


def write_gif(
    path: Path,
    figure: Figure,
    show: Callable[[int], None],
    t: Float[np.ndarray, " times"] | None,
    *,
    frames: Iterable[int],
    frames_per_second: float,
    title: str = "",
) -> None:
    """Writes a GIF by calling `show(frame)` for every frame, with the title and, unless t is `None`, the time in s.

    Raises:
        InputError: the file cannot be written. It is written completely or not at all.
    """
    heading = figure.suptitle("", fontsize=style.TEXT, family="monospace")
    figure.set_dpi(DPI)
    canvas, images = FigureCanvasAgg(figure), []
    for frame in frames:
        show(frame)
        heading.set_text(title if t is None else f"{title}  t = {t[frame]:5.2f} s".strip())
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(dither=Image.Dither.NONE))
        # Fix the axes at the positions of the first frame.
        figure.set_layout_engine("none")
    # One palette for all frames and no dithering make the file a third smaller.
    some = [image.convert("RGB") for image in images[:: max(1, len(images) // 6)]]
    palette = Image.fromarray(np.concatenate([np.asarray(image) for image in some])).quantize(COLOURS)
    entries = np.reshape(palette.getpalette(), (-1, 3))
    entries[entries.sum(axis=1) >= 750] = 255  # the background is white
    palette.putpalette(entries.ravel().tolist())
    images = [image.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    content, duration = io.BytesIO(), round(1000 / frames_per_second)
    images[0].save(content, "gif", save_all=True, append_images=images[1:], duration=duration, loop=0)
    write_bytes(path, content.getvalue())


def write_motion_gif(
    path: Path,
    motions: Mapping[str, Motions],
    *,
    shown: int = 0,
    tail: int = 20,
    stride: int = 1,
    units: tuple[str, str] = ("", ""),
    frames_per_second: float = 20.0,
) -> None:
    """Writes a GIF with one motion of every system in its own panel, over the truth in black if "truth" is among them.

    With one coordinate a panel is the phase plane; with 2 n coordinates it shows n bodies in a plane.

    `tail` is the number of samples in the trace behind a body, `stride` the number of samples between two frames;
    `units` are those of one coordinate of q and of p, empty for none.

    Raises:
        InputError: there is no motion, or motions have different lengths.
    """
    require_positive(tail=tail, stride=stride, frames_per_second=frames_per_second)
    t = next(iter(motions.values())).t if motions else np.zeros(0)
    _require_common_length(t, {name: moved.q.shape[1] for name, moved in motions.items()})
    curves = {name: plane_paths(moved, shown) for name, moved in motions.items()}
    plane = next(iter(motions.values())).q.shape[2] == 1
    framed = curves.get(TRUTH) or [curve for paths in curves.values() for curve in paths]
    corners = 1.2 * np.nanmax(np.abs(framed), axis=(0, 2))
    if not plane:
        corners[:] = corners.max()
    models = [name for name in motions if name != TRUTH] or [TRUTH]
    width = min(style.WIDTH, 3.4 * len(models))
    figure, axes = style.figure(1, len(models), width=width, height=width / len(models) + 0.6, sharey=True, dpi=DPI)
    lines: list[tuple[Artist, Artist, tuple[np.ndarray, np.ndarray]]] = []
    for axis, name in zip(axes[0], models, strict=True):
        axis.set(xlim=(-corners[0], corners[0]), ylim=(-corners[1], corners[1]), box_aspect=1)
        over = TRUTH in motions and name != TRUTH
        style.title(axis, f"{name}, over the truth" if over else name, color=style.colour(name))
        axis.set_xlabel(style.with_unit("q", units[0]) if plane else "x, m")
        for system in (TRUTH, name) if over else (name,):
            width, size = (3.0, 8) if system == TRUTH else (1.4, 5)
            for curve in curves[system]:
                (line,) = axis.plot([], [], color=style.colour(system), linewidth=width)
                (body,) = axis.plot([], [], "o", color=style.colour(system), markersize=size)
                lines.append((line, body, curve))
    axes[0, 0].set_ylabel(style.with_unit("p", units[1]) if plane else "y, m")

    def show(index: int) -> None:
        for line, body, (x, y) in lines:
            for artist, part in ((line, slice(max(0, index - tail), index + 1)), (body, slice(index, index + 1))):
                artist.set(data=(x[part], y[part]))

    write_gif(path, figure, show, t, frames=range(0, len(t), stride), frames_per_second=frames_per_second)


def _require_common_length(t: np.ndarray, lengths: dict[str, int]) -> None:
    if not lengths or len(t) == 0:
        raise InputError("there is no motion to show; give at least one system, with at least one sample")
    for name, length in lengths.items():
        if length != len(t):
            raise InputError(f"{name} has {length} samples for {len(t)} times; expected one for each")
