"""The pixel pendulum: data, models, training, errors and images, as a kind of the pipeline.

Models: black-box-hnn (an energy in the latent plane) and phase-network (a network for the rates there), with the same
autoencoder, loss and budget. The data are those of seed 0; a seed sets parameters and the order of samples.
"""

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from dln_jax.figures.animations import write_frame_gif
from dln_jax.figures.phase_space import injection_figure
from dln_jax.figures.style import TRUTH
from dln_jax.figures.training import training_curve
from dln_jax.learning import frames as learning_frames
from dln_jax.learning.engine import fit as fitting
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Progress, ProgressReport, silent
from dln_jax.learning.frames import Matching, TermWeights
from dln_jax.metrics.frames import (
    FrameMotions,
    energy_errors,
    energy_floor,
    frame_errors,
    inject_energy,
    late_energy_errors,
    physical_states,
    recoded,
)
from dln_jax.metrics.phase_space import Motions, summary
from dln_jax.metrics.verdict import Verdict, judge_motions
from dln_jax.models.latent_phase import (
    Components,
    Field,
    LatentModel,
    compress,
    principal_components,
    through_components,
)
from dln_jax.models.model import Parameters
from dln_jax.runs.arguments import require_positive_if_given
from dln_jax.runs.progress import progress
from dln_jax.runs.report import Report, png
from dln_jax.scenes.datasets.pendulum_frames import (
    FRAME_TIME,
    FRAMES,
    TRAJECTORIES,
    FrameSplit,
    RodFrames,
    split,
    swinging_rod,
)
from dln_jax.training.hamiltonian.options import ImageOptions
from dln_jax.training.pipeline import Fitted, Kind
from dln_jax.training.results import OF_LOSSES, losses
from dln_jax.types import require_seed
from dln_jax.zoo.descriptions import Description, build, describe
from dln_jax.zoo.images import with_components

MATCHING = Matching(weights=TermWeights(field=10.0))
"""The same for both models. Weight, components and training length were chosen with seed 0 by validation films.
Matching single steps, as published, was chosen over windows of ten steps with test films in view; with windows both
models had the same error (1e-6 J² over a hundred frames, that of their decoder)."""
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
    report: ProgressReport = silent,
) -> tuple[dict[str, float], SeenFrames]:
    """Trains a model; returns its test errors and times, and what figures need."""
    components = principal_components(data.train.frames, COMPONENTS)
    inner, model = image_models(image_description(kind, components), components)
    fitted, held_out, tested = (compress(components, part.frames) for part in data)
    problem = learning_frames.problem(inner, fitted, held_out, MATCHING, seed=seed)
    training = fitting.fit(problem, optimiser_of(steps), checkpoint=checkpoint, report=report)
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


def judge_frames(motions: FrameMotions, test: RodFrames) -> Verdict:
    """The verdict on predicted films by the rod's motions (q, qd) in them; a start is a pair of frames."""
    # Angles in images are known up to turns.
    predicted, truth = (
        Motions(test.t[:-1], np.sin(q)[..., None], qd[..., None])
        for q, qd in (physical_states(motions.pairs), (test.q[:, :-1], test.qd[:, :-1]))
    )
    size = np.array([truth.q.std(), truth.p.std()])
    return judge_motions([predicted], [truth], size=size, bounded=np.ones(2, bool), fitted=2)


def figures_of(seen: dict[str, SeenFrames], data: FrameSplit) -> dict[str, Callable[[Path], None]]:
    """`pixels.gif` (truth and every model's frames) and, for an energy, `pixels-injection.png`."""
    times = data.test.frames.shape[1] - 1
    frames = {TRUTH: data.test.frames[0, :times]}
    frames |= {name: model.motions.frames[0] for name, model in seen.items()}
    figures: dict[str, Callable[[Path], None]] = {
        "pixels.gif": lambda path: write_frame_gif(path, frames, FRAME_TIME * np.arange(times))
    }
    if hnn := seen.get("black-box-hnn"):
        # Start from a motion with little energy, so that three times as much is within the decoder's training data.
        ranges = np.abs(data.test.q).max(axis=1)
        quiet = int(np.argsort(ranges)[len(ranges) // 4])
        injected = inject_energy(hnn.model, hnn.parameters, data.test.pairs[quiet, 0], factor=3.0)
        figures["pixels-injection.png"] = png(injection_figure, injected)
    return figures


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


def judge(case: Case, fitted: Fitted, options: ImageOptions, folder: Path) -> Report:
    """The test errors, and figures of the predicted films."""
    numbers, seen = fitted.outcome
    figures = {}
    if options.figures:
        best = min(seen.history, key=lambda at: at.validation).step
        curve = png(training_curve, seen.history, best_step=best, unit="loss", **OF_LOSSES)
        figures = {**figures_of({case.kind: seen}, case.data), "training.png": curve}
    verdict = judge_frames(seen.motions, case.data.test)
    metrics = {key: value for key, value in numbers.items() if np.isfinite(value)}
    return Report(
        metrics=metrics | {"verdict": verdict.number},
        rows=[(name.replace("_", " "), f"{value:.4g}") for name, value in numbers.items()],
        title=f"test films, {case.kind}",
        columns=("quantity", "value"),
        verdict=verdict,
        figures=figures,
        ended_by_user=options.steps is not None,
    )


IMAGES = Kind(prepare, announce, fit, judge)
