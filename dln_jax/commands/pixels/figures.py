"""Figures of the pixel pendulum: a predicted film over the truth, and a motion whose energy is raised."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from dln_jax.commands.pixels.frames import FRAME_TIME, PIXELS, SIDE, Films, inject_energy
from dln_jax.figures import style
from dln_jax.models.latent_phase import ImageModel

ONLY_TRUTH, ONLY_MODEL = np.array([0.0, 0.45, 0.7]), np.array([1.0, 0.55, 0.3])
"""Colours of pixels present in only one of two films; their sum is white."""


def write_film(
    path: Path, name: str, predicted: Float[np.ndarray, "T pixels"], truth: Float[np.ndarray, "T pixels"]
) -> None:
    """Writes the film that a model predicts, over the truth, as a GIF. White pixels agree; intensities are clipped."""
    true, model = (np.clip(frames, 0, 1).reshape(-1, SIDE, SIDE, 1) for frames in (truth, predicted))
    colours = true * ONLY_TRUTH + model * ONLY_MODEL
    figure, ((axis,),) = style.figure(width=2.4, height=3.2, dpi=style.FILM_DPI)
    image = axis.imshow(np.zeros((SIDE, SIDE, 3)))
    style.title(axis, name, color=style.colour(name))
    axis.set(xticks=[], yticks=[])
    axis.grid(False)
    figure.supxlabel("white: both  blue: truth only\norange: model only", fontsize=7)
    times = np.arange(len(truth))
    style.write_gif(
        path,
        figure,
        lambda index: image.set_data(colours[index]),
        FRAME_TIME * times,
        frames=times,
        frames_per_second=1 / FRAME_TIME,
    )


def injection_figure(model: ImageModel, parameters: Any, test: Films) -> Figure:
    """Decoded frames before and after the energy of a motion is tripled, the latent path, and energies over time."""
    # A motion with little energy, so that three times as much is within the decoder's training data.
    ranges = np.abs(test.q).max(axis=1)
    quiet = int(np.argsort(ranges)[len(ranges) // 4])
    t, q, p, pairs, level, physical = inject_energy(model, parameters, test.pairs[quiet, 0], factor=3.0)
    half, shown = len(t) // 2, 7
    figure = style.blank(height=5.0)
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.05])[:, 0]
    colours = style.BLUE, style.VERMILLION
    rows = upper.subplots(2, shown, squeeze=False)
    for row, first, colour, name in zip(rows, (0, half), colours, ("before", "after"), strict=True):
        for axis, index in zip(row, np.linspace(first, first + half - 1, shown).astype(int), strict=True):
            axis.imshow(pairs[index, :PIXELS].reshape(SIDE, SIDE), cmap="gray", vmin=0, vmax=1)
            axis.set(xticks=[], yticks=[])
            style.title(axis, f"{t[index]:.2f} s", fontsize=style.SMALL, color=colour)
        row[0].set_ylabel(name, color=colour, fontsize=style.TEXT)
    plane, levels = lower.subplots(1, 2, width_ratios=[1.0, 1.6])
    joules = levels.twinx()
    style.prepare(plane, levels, joules)
    for part, colour in zip((slice(0, half), slice(half, None)), colours, strict=True):
        plane.plot(q[part], p[part], color=colour, linewidth=1.5)
        levels.plot(t[part], level[part], color=colour, linewidth=5.0, alpha=0.4)
        joules.plot(t[part], physical[part], ":", color="black", linewidth=1.6)
    plane.annotate("", (q[half], p[half]), (q[half - 1], p[half - 1]), arrowprops={"arrowstyle": "->", "lw": 1.6})
    plane.set(xlabel="latent q, 1", ylabel="latent p, 1 per frame")
    style.title(plane, "path in the latent plane")
    levels.set(xlabel="t, s", ylabel="latent H / H at the start, 1")
    style.title(levels, "energy: latent (band), of the frames (dots)")
    joules.set_ylabel("energy of the frames, J")
    joules.grid(False)
    joules.spines["right"].set_visible(True)
    start = physical[:half].mean()
    top = 1.25 * max(level.max(), physical.max() / start)
    levels.set_ylim(0.0, top)
    joules.set_ylim(0.0, top * start)
    return figure
