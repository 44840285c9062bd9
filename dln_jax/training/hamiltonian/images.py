"""Trains models of images, from options to a run folder."""

from dataclasses import dataclass

import numpy as np

from dln_jax.cli.arguments import Unstated, require_positive_if_given
from dln_jax.cli.options import Drawn, Resumable
from dln_jax.cli.progress import progress
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.figures.training import training_curve
from dln_jax.files import write_figure, write_json
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.models.latent_phase import Field
from dln_jax.training.hamiltonian import pixels as pixel_task
from dln_jax.training.results import OF_LOSSES, losses
from dln_jax.types import require_seed
from dln_jax.zoo.images import with_components
from dln_jax.zoo.run import save


@dataclass(frozen=True)
class Options(Resumable, Drawn):
    """What to train on, how, and where the results go."""

    model: Field = "black-box-hnn"
    """An energy in the latent plane, or a network that gives the rates there."""
    trajectories: Unstated[int] = None
    """Generated films (default: as published)."""
    steps: Unstated[int] = None
    """Steps of adam (default: those of the published recipe)."""
    seed: int = 0
    """Of the initial parameters and the shuffling; 0 to 4294967295."""


def run(given: Options, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ..."""
    require_seed(given.seed)
    require_positive_if_given(given, ["steps", "trajectories"])
    kind, optimiser, data = given.model, pixel_task.optimiser_of(given.steps), pixel_task.pixel_data(given.trajectories)
    with command_folder(given, command) as folder:
        print(f"pixels: {len(data.train.q)} films to train on, {len(data.validation.q)} to select by; {kind}, f32")
        known = identity(optimiser, [data.train.frames, data.validation.frames], model=kind, seed=given.seed)
        with progress(optimiser.steps) as show:
            numbers, seen = pixel_task.measure_pixels(
                kind,
                data,
                seed=given.seed,
                steps=optimiser.steps,
                checkpoint=Checkpoint(folder, known, given.resume),
                report=lambda at: show(at.step, losses(at)),
            )
        description = pixel_task.image_description(kind, seen.components)
        save(folder, description, with_components(seen.components, seen.parameters))
        write_json(folder / "metrics.json", {key: value for key, value in numbers.items() if np.isfinite(value)})
        if given.figures:
            pixel_task.draw_pixels({kind: seen}, data, folder)
            best = min(seen.history, key=lambda at: at.validation).step
            write_figure(
                folder / "training.png", training_curve(seen.history, best_step=best, unit="loss", **OF_LOSSES)
            )
        for name, value in numbers.items():
            print(f"{name.replace('_', ' '):32s} {value:10.4g}")
        print(f"run folder: {folder}")
