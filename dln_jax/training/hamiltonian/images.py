"""Trains models of images, as a kind of the pipeline."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.cli.arguments import require_positive_if_given
from dln_jax.cli.progress import progress
from dln_jax.figures.training import training_curve
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.scenes.datasets.pendulum_frames import FrameSplit
from dln_jax.training.hamiltonian.options import ImageOptions
from dln_jax.training.hamiltonian.pixels import (
    figures_of,
    image_description,
    measure_pixels,
    optimiser_of,
    pixel_data,
)
from dln_jax.training.pipeline import Fitted, Judged, Kind, png
from dln_jax.training.results import OF_LOSSES, losses
from dln_jax.types import require_seed
from dln_jax.zoo.images import with_components


class Case(NamedTuple):
    """Films, the model of their latent plane, and its optimiser."""

    kind: str
    optimiser: Adam
    data: FrameSplit


def prepare(options: ImageOptions) -> Case:
    """Generates the films."""
    require_seed(options.seed)
    require_positive_if_given(options, ["steps", "trajectories"])
    return Case(options.model, optimiser_of(options.steps), pixel_data(options.trajectories))


def announce(case: Case) -> Iterator[str]:
    """A line on the films and the model."""
    train, validation, _ = case.data
    yield f"pixels: {len(train.q)} films to train on, {len(validation.q)} to select by; {case.kind}, f32"


def fit(case: Case, options: ImageOptions, folder: Path, mesh: Mesh | None) -> Fitted:
    """Trains autoencoder and latent dynamics together, and measures them on the test films."""
    kind, optimiser, data = case
    known = identity(optimiser, [data.train.frames, data.validation.frames], model=kind, seed=options.seed)
    with progress(optimiser.steps) as show:
        numbers, seen = measure_pixels(
            options.model,
            data,
            seed=options.seed,
            steps=optimiser.steps,
            checkpoint=Checkpoint(folder, known, options.resume),
            report=lambda at: show(at.step, losses(at)),
        )
    description = image_description(options.model, seen.components)
    return Fitted(description, with_components(seen.components, seen.parameters), (numbers, seen))


def judge(case: Case, fitted: Fitted, options: ImageOptions, folder: Path) -> Judged:
    """The test errors, and figures of the predicted films."""
    numbers, seen = fitted.outcome
    figures = {}
    if options.figures:
        best = min(seen.history, key=lambda at: at.validation).step
        curve = png(training_curve, seen.history, best_step=best, unit="loss", **OF_LOSSES)
        figures = {**figures_of({case.kind: seen}, case.data), "training.png": curve}
    return Judged(
        metrics={key: value for key, value in numbers.items() if np.isfinite(value)},
        rows=lambda _: [(name.replace("_", " "), f"{value:.4g}") for name, value in numbers.items()],
        title=f"test films, {case.kind}",
        columns=("quantity", "value"),
        figures=figures,
    )


IMAGES = Kind(prepare, announce, fit, judge)
