"""Animated GIFs, written frame by frame."""

import io
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from dln_jax.figures import style
from dln_jax.files import write_bytes

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
