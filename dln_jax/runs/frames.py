"""What `train_hnn --task pixels` does: from a command line to a trained model of pictures in a run folder."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import stored_arguments
from dln_jax.datasets.pendulum_frames import FrameSplit
from dln_jax.figures import dynamics as figures
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.learning.engine.runs import Checkpoint, Progress, fingerprint
from dln_jax.studies.hamiltonian import pixels as pixel_task
from dln_jax.types import InputError, require_positive, require_seed
from dln_jax.zoo.load_latent import save_latent

KINDS = {"auto": "hnn", "black-box": "hnn", "baseline": "baseline"}
TAKEN = ("model", "task", "trajectories", "steps", "seed", "out", "resume", "figures")
"""Options that the task reads."""


def run_pixels(given: Any) -> None:
    """Trains, evaluates, and writes the run folder."""
    console = Console(highlight=False, soft_wrap=True)
    check(given)
    kind = KINDS[given.model]
    data = pixel_task.pixel_data(given.trajectories)
    with run_folder(given.out, "train_hnn", resume=given.resume) as folder:
        train_into(folder, given, kind, data, console)


def train_into(folder: Path, given: Any, kind: str, data: FrameSplit, console: Console) -> None:
    """Trains, evaluates, and writes the files of the run."""
    write_json(folder / CONFIG, stored_arguments(given))
    console.print(f"pixels: {len(data.train.q)} films to train on, {len(data.validation.q)} to select by; {kind}, f32")
    steps = given.steps or pixel_task.RECIPE.steps
    identity = {
        "settings": {"model": kind, "seed": given.seed, "steps": steps},
        "data": fingerprint([data.train.frames, data.validation.frames]),
    }
    with progress(steps) as show:
        numbers, seen = pixel_task.measure_pixels(
            kind,
            seed=given.seed,
            steps=steps,
            trajectories=given.trajectories,
            checkpoint=Checkpoint(folder, identity, given.resume),
            report=lambda at: show(at.step, shown(at)),
        )
    save_latent(folder, kind, seen.components, seen.parameters)
    write_json(folder / "metrics.json", {key: value for key, value in numbers.items() if np.isfinite(value)})
    if given.figures:
        pixel_task.draw_pixels({kind: seen}, data, folder)
        history = seen.history
        best = min(history, key=lambda at: at.validation).step
        words = {"error": "loss", "loss": "training loss", "unit": "loss"}
        write_figure(folder / "training.png", figures.training_curve(history, best_step=best, **words))
    for name, value in numbers.items():
        console.print(f"{name.replace('_', ' '):32s} {value:10.4g}")
    console.print(f"run folder: {folder}")


def check(given: Any) -> None:
    """Refuses what the task does not take, before anything is written."""
    if given.model not in KINDS:
        raise InputError(f"model is '{given.model}'; expected one of {', '.join(KINDS)} for pixels")
    unset = type(given)()
    for name, value in vars(given).items():
        if name not in TAKEN and value != getattr(unset, name):
            raise InputError(f"--{name.replace('_', '-')} is not for pixels, whose networks are settled; leave it out")
    require_seed(given.seed)
    for name in ("steps", "trajectories"):
        if getattr(given, name) is not None:
            require_positive(**{name: getattr(given, name)})


def shown(at: Progress) -> str:
    """A line of progress."""
    return f"loss {at.loss:.2e}  validation {at.validation:.2e}"
