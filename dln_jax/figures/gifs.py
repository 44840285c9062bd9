"""Writing animated GIFs, frame by frame."""

import tempfile
from collections.abc import Callable
from pathlib import Path

from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

from dln_jax.files import write_bytes

DPI = 80


def write_gif(
    path: Path, figure: Figure, show: Callable[[int], None], *, frames: range, frames_per_second: float
) -> None:
    """Writes what `show(frame)` draws into the figure, for each frame; the file is written whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    writer = PillowWriter(fps=frames_per_second)  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "drawn.gif"  # Pillow knows the format by the ending
        with writer.saving(figure, str(drawn), DPI):
            for frame in frames:
                show(frame)
                writer.grab_frame()
                # The axes keep the places that the first frame gave them.
                figure.set_layout_engine("none")
        write_bytes(path, drawn.read_bytes())
