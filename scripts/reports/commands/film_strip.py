"""Draw the strip of films on the first page of the documentation: each is trained or designed, and simulated, here.

Writes films.gif: an arm writes with learned torques, three bodies move by a learned energy, a pendulum is swung up by
its energy, and a soft body crawls. It takes about two minutes.
"""

from dataclasses import dataclass

import jax
import numpy as np

from dln_jax.cli.options import Folder
from dln_jax.cli.running import command_folder
from dln_jax.figures import style
from dln_jax.figures.animations import DPI, write_gif
from scripts.reports.films import FILMS


@dataclass(frozen=True)
class Arguments(Folder):
    """How long the films are, and where they go."""

    frames: int = 100
    """Frames of the strip."""
    frames_per_second: float = 15.0
    """Frames shown in a second."""


def main(given: Arguments) -> None:
    """Makes the films, draws and writes them."""
    jax.config.update("jax_enable_x64", True)
    with command_folder(given, "film_strip") as folder:
        films = {}
        for title, film in FILMS.items():
            films[title] = film(given.frames)
            print(f"{title}: done")
        figure, axes = style.figure(1, len(films), height=2.6, dpi=DPI)
        shows = []
        for axis, (title, prepare) in zip(axes[0], films.items(), strict=True):
            shows.append(prepare(axis))
            style.title(axis, title, fontsize=style.SMALL)

        def show(frame: int) -> None:
            for draw in shows:
                draw(frame)

        t = np.arange(given.frames) / given.frames_per_second
        write_gif(
            folder / "films.gif",
            figure,
            show,
            t,
            frames=range(given.frames),
            frames_per_second=given.frames_per_second,
        )
        print(f"run folder: {folder}")
