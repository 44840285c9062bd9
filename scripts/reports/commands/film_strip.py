"""Draw the strip of films on the first page of the documentation: each is trained or designed, and simulated, here.

Writes films.gif: an arm writes with learned torques, three bodies move by a learned energy, a pendulum is swung up by
its energy, and a soft body crawls. It takes about two minutes.
"""

from dataclasses import dataclass

import jax

from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.figures import style
from dln_jax.figures.animations import DPI, write_gif
from dln_jax.types import require_positive
from scripts.reports.films import FILMS


@dataclass(frozen=True)
class Arguments(Folder):
    """How long the films are, and where they go."""

    frames: int = 100
    """Frames of the strip."""
    frames_per_second: float = 15.0
    """Frames shown in a second."""


def main(options: Arguments) -> None:
    """Makes the films, draws and writes them."""
    require_positive(frames=options.frames, frames_per_second=options.frames_per_second)
    jax.config.update("jax_enable_x64", True)
    with command_folder(options, "film_strip") as folder:
        films = {}
        for title, film in FILMS.items():
            films[title] = film(options.frames)
            print(f"{title}: done")
        figure, axes = style.figure(1, len(films), height=2.1, width=9.0, dpi=DPI)
        shows = []
        for axis, (title, prepare) in zip(axes[0], films.items(), strict=True):
            shows.append(prepare(axis))
            axis.set_anchor("S")
            axis.text(0.5, 1.0, title, transform=axis.transAxes, ha="center")

        def show(frame: int) -> None:
            for draw in shows:
                draw(frame)

        path, frames = folder / "films.gif", range(options.frames)
        write_gif(path, figure, show, None, frames=frames, frames_per_second=options.frames_per_second)
        print(f"run folder: {folder}")
