"""Fits an autoencoder and the field in its latent plane to images of motions (Greydanus, Dzamba and Yosinski 2019).

    loss = AE + CC + 0.1 HNN                              published weights; means over samples and components
    AE   = |decoder(encoder(x_k)) - x_k|²                 reconstruction of the images
    CC   = |z_p,k - (z_q,k+1 - z_q,k)|²                   the momentum is the change of the coordinate per frame
    HNN  = |flow_j(z_0) - z_j|²                           the field moves the latent states as the images do

Samples are windows of consecutive frames, k = 0 .. W - 1; x_k holds the frames k and k + 1. The published term is a
forward difference, z_1 - z_0 = rates(z_0), whose error is quadratic in the frame time. Here RK4 integrates the field
from a window's first state to all later ones. A window of two gives the published term without that error; longer
windows also penalise errors that grow during a motion. The learning rate decays by a cosine; the published is constant.

Latent states have no scale of their own: CC and HNN fall when the latent plane shrinks, and AE does not change. To
remove that incentive, every error is divided by the variance of its target in the batch (z_p for CC), unless `relative`
is off. The published weights then act on other magnitudes: on the pendulum HNN needs 10 in place of 0.1 until the
decoder, and no longer the motion, limits the accuracy.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.learning.engine.problem import Problem, unmonitored
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.models.latent_phase import LatentModel
from dln_jax.models.model import Parameters
from dln_jax.types import InputError, Scalar


class TermWeights(NamedTuple):
    """Weights of the terms of the loss."""

    autoencoder: float = 1.0
    coordinate: float = 1.0
    field: float = 0.1


class Matching(NamedTuple):
    """Windows and loss of the fit."""

    window: int = 2
    """Images (of two frames) per window."""
    weights: TermWeights = TermWeights()
    relative: bool = True
    """Whether errors of latent states are relative to their variances; the published ones are not."""


class Terms(NamedTuple):
    """Terms of the loss, before weighting."""

    autoencoder: Scalar
    coordinate: Scalar
    field: Scalar


def terms(
    model: LatentModel, parameters: Parameters, windows: Float[Array, "N frames pixels"], relative: bool
) -> Terms:
    """Returns AE, CC and HNN of windows of W + 1 frames."""
    system = model.apply(parameters)
    step = rk4(lambda t, state: system.field.rates(*state))
    pairs = jnp.concatenate([windows[:, :-1], windows[:, 1:]], axis=2)
    q, p = jax.vmap(jax.vmap(system.encode))(pairs)
    images = jax.vmap(jax.vmap(system.decode))(q, p)
    t = jnp.arange(pairs.shape[1], dtype=q.dtype)
    moved = jax.vmap(lambda q, p: rollout(step, (q, p), t))(q[:, 0], p[:, 0])
    spread = [jnp.var(state) if relative else 1.0 for state in (q, p)]
    of_q, of_p = (
        jnp.mean((predicted - state)[:, 1:] ** 2) / size
        for predicted, state, size in zip(moved, (q, p), spread, strict=True)
    )
    errors = images - pairs
    return Terms(
        jnp.mean(errors**2) / (jnp.mean(jnp.var(pairs, axis=(0, 1))) if relative else 1.0),
        jnp.mean((p[:, :-1] - (q[:, 1:] - q[:, :-1])) ** 2) / spread[1],
        (of_q + of_p) / 2,
    )


def loss(model: LatentModel, matching: Matching, parameters: Parameters, windows: Array) -> Scalar:
    """The weighted sum of `terms`."""
    (autoencoder, coordinate, field), weights = terms(model, parameters, windows, matching.relative), matching.weights
    return weights.autoencoder * autoencoder + weights.coordinate * coordinate + weights.field * field


def windows(frames: Float[np.ndarray, "K T pixels"], length: int) -> Float[np.ndarray, "N length pixels"]:
    """Cuts the frames of trajectories into consecutive windows; the remainder at the end of a trajectory is dropped.

    Raises:
        InputError: trajectories are shorter than a window.
    """
    K, T, pixels = frames.shape
    count = T // length
    if count == 0:
        raise InputError(f"trajectories have {T} frames; expected at least the {length} of a window: lower window")
    return frames[:, : count * length].reshape(K * count, length, pixels)


def problem(
    model: LatentModel,
    train: Float[np.ndarray, "K T pixels"],
    validation: Float[np.ndarray, "V T pixels"],
    matching: Matching = Matching(),  # noqa: B008
    *,
    seed: int = 0,
) -> Problem:
    """Builds the problem of fitting a model to the frames of trajectories, for Adam.

    Validation trajectories select the parameters, by the same loss. The seed sets initial parameters and window order.

    Raises:
        InputError: settings are out of range, or trajectories are shorter than a window.
    """
    if matching.window < 2:
        raise InputError(f"window is {matching.window}; expected at least 2 images, one to predict the other from")
    fitted, held_out = (jnp.asarray(windows(frames, matching.window + 1)) for frames in (train, validation))

    def score(parameters: Parameters) -> tuple[Scalar, Scalar]:
        return unmonitored(loss(model, matching, parameters, held_out))

    return Problem(
        residual=None,
        parameters=jax.jit(model.init)(jax.random.key(seed)),
        arrays=(fitted,),
        score=score,
        seed=seed,
        loss=lambda parameters, batch: loss(model, matching, parameters, *batch),
        loss_is_mean=not matching.relative,  # the variance of a batch is not the mean of its parts' variances
    )
