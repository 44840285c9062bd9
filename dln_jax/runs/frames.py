"""Training a model of pictures into a run folder."""

from pathlib import Path

import numpy as np
from rich.console import Console

from dln_jax.command_line.progress import progress
from dln_jax.datasets.pendulum_frames import FrameSplit
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.problem import Progress
from dln_jax.models.latent_phase import Field
from dln_jax.studies.hamiltonian import pixels as pixel_task
from dln_jax.zoo.pictures import with_components
from dln_jax.zoo.run import save


def train_into(
    folder: Path,
    kind: Field,
    data: FrameSplit,
    *,
    seed: int,
    steps: int,
    resume: bool = False,
    figures: bool = True,
) -> None:
    """Trains, evaluates, and writes the files of the run into an existing folder.

    Args:
        folder: of the run.
        kind: of what moves in the latent plane.
        data: films in three parts, as of `pixel_data`.
        seed: of the initial parameters and the shuffling.
        steps: of Adam.
        resume: continue from the folder's checkpoint.
        figures: whether they are drawn.
    """
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"pixels: {len(data.train.q)} films to train on, {len(data.validation.q)} to select by; {kind}, f32")
    optimiser = pixel_task.optimiser_of(steps)
    known = identity(optimiser, [data.train.frames, data.validation.frames], model=kind, seed=seed)
    with progress(optimiser.steps) as show:
        numbers, seen = pixel_task.measure_pixels(
            kind,
            data,
            seed=seed,
            steps=steps,
            checkpoint=Checkpoint(folder, known, resume),
            report=lambda at: show(at.step, shown(at)),
        )
    description = pixel_task.picture_description(kind, seen.components)
    save(folder, description, with_components(seen.components, seen.parameters))
    write_json(folder / "metrics.json", {key: value for key, value in numbers.items() if np.isfinite(value)})
    if figures:
        pixel_task.draw_pixels({kind: seen}, data, folder)
        history = seen.history
        best = min(history, key=lambda at: at.validation).step
        words = {"error": "loss", "loss": "training loss", "unit": "loss"}
        write_figure(folder / "training.png", training_curve(history, best_step=best, **words))
    for name, value in numbers.items():
        console.print(f"{name.replace('_', ' '):32s} {value:10.4g}")
    console.print(f"run folder: {folder}")


def shown(at: Progress) -> str:
    """A line of progress."""
    return f"loss {at.loss:.2e}  validation {at.validation:.2e}"
