"""Train a Hamiltonian network on films of a pendulum.

An autoencoder maps the films to a plane, in which a Hamiltonian or a plain network gives the motion. The films are
generated: 28 x 28 pixels of a swinging rod. The run folder gets config.json, metrics.json, model.safetensors and
model.json (load them with dln_jax.load), a checkpoint for --resume, and figures.
"""

from dataclasses import dataclass
from typing import Literal

from dln_jax.options import Drawn, Resumable, Unstated
from dln_jax.runs.arguments import require_positive_if_given


@dataclass(frozen=True)
class Arguments(Drawn, Resumable):
    """Films of a pendulum, what is learned from them, and where the results go."""

    model: Literal["black-box-hnn", "phase-network"] = "black-box-hnn"
    """An energy in the latent plane, or a network that gives the rates there."""
    trajectories: Unstated[int] = None
    """Number of generated films (default: as published)."""
    steps: Unstated[int] = None
    """Steps of Adam (default: as published)."""
    seed: int = 0
    """Seed for parameters and shuffling."""


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    import jax
    import numpy as np

    from dln_jax.commands.pixel_films import PIXELS, TRAJECTORIES, judge_films, swinging_rod
    from dln_jax.commands.pixels import fit, injection_figure, measure, optimiser, write_film
    from dln_jax.figures.training import OF_LOSSES, training_curve
    from dln_jax.learning.engine.checkpoint import Checkpoint, identity
    from dln_jax.learning.engine.problem import losses
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import Report, finish, png, rows_of
    from dln_jax.zoo.descriptions import build
    from dln_jax.zoo.run import save

    require_positive_if_given(options, ["steps", "trajectories"])
    kind, adam = options.model, optimiser(options.steps)
    train, validation, test = swinging_rod(options.trajectories or TRAJECTORIES)
    with command_folder(options, "train_hnn_pixels") as folder:
        print(f"pixels: {len(train.q)} films for training, {len(validation.q)} for validation; {kind}, f32")
        known = identity(adam, [train.frames, validation.frames], model=kind, seed=options.seed)
        with progress(adam.steps) as show:
            description, parameters, training = fit(
                kind,
                train,
                validation,
                seed=options.seed,
                steps=adam.steps,
                checkpoint=Checkpoint(folder, known, options.resume),
                report=lambda at: show(at.step, losses(at)),
            )
        save(folder, description, jax.tree.map(np.float32, parameters))
        numbers, films = measure(description, parameters, training, test)
        verdict = judge_films(films, test)
        curve = {"best_step": training.best_step, "unit": "loss", **OF_LOSSES}
        figures = {
            "pixels.gif": lambda path: write_film(path, kind, films[0, :, :PIXELS], test.frames[0, :-1]),
            "training.png": png(training_curve, training.history, **curve),
        }
        if kind == "black-box-hnn":
            figures["pixels-injection.png"] = png(injection_figure, build(description), parameters, test)
        report = Report(
            metrics={key: value for key, value in numbers.items() if np.isfinite(value)} | {"verdict": verdict.number},
            rows=rows_of(numbers),
            title=f"test films, {kind}",
            verdict=verdict,
            figures=figures,
            ended_by_user=options.steps is not None,
        )
        finish(folder, options, report)
