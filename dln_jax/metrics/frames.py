"""Errors of motions that are predicted as pictures: the physical state is read from the pictures, and its energy.

    q       argmin |render(q) - frame|², on a grid and then by Gauss-Newton
    qd      such that the rod moves from the first frame's q to the second's in the time between them
    energy  mean over starts and times of (H(q, qd) - H(q_true, qd_true))², in J²

The velocity comes from the rod's own motion, and not from a difference quotient, so that true frames have the true
energy: what is left is the estimator's floor, which `energy_floor` measures.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.datasets.pendulum_frames import FRAME_TIME, PIXELS, Frames, energy, render, rod
from dln_jax.mechanics.integrators import advance, rk4, second_order
from dln_jax.metrics.phase_space import Motions, finite_or_infinite, predict, summary
from dln_jax.models.latent_phase import LatentModel
from dln_jax.models.model import Parameters
from dln_jax.precision import in_float64, with_float64
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.types import Scalar

GRID = 180
"""Angles of the full circle at which the search starts; a step of Gauss-Newton is at most their distance."""
ITERATIONS = 20
_BATCH = 256


class FrameMotions(NamedTuple):
    """K predicted motions."""

    latent: Motions
    """By frame number; z_q as q and z_p as p."""
    pairs: Float[np.ndarray, "K T input"]
    """Two decoded frames for each time."""

    @property
    def frames(self) -> Float[np.ndarray, "K T pixels"]:
        """The first frame of each pair."""
        return self.pairs[..., : self.pairs.shape[-1] // 2]


def fitted_angle(frame: Float[Array, " pixels"], grid: Float[Array, " G"], drawn: Float[Array, "G pixels"]) -> Scalar:
    """q of a frame, in rad, from the best of a grid's angles and their frames."""
    spacing = 2 * jnp.pi / GRID

    def picture(q: Scalar) -> Array:
        return render(q).ravel()

    def iteration(_, q: Scalar) -> Scalar:
        image, slope = jax.jvp(picture, (q,), (jnp.ones_like(q),))
        return q + jnp.clip(slope @ (frame - image) / (slope @ slope), -spacing, spacing)

    start = grid[jnp.argmin(jnp.sum(drawn**2, axis=1) - 2 * drawn @ frame)]
    return jax.lax.fori_loop(0, ITERATIONS, iteration, start)


def velocity_between(first: Scalar, second: Scalar) -> Scalar:
    """qd at the first of two angles, in rad/s, with which the rod is at the second after the time of a frame."""
    scene = rod()
    step = rk4(second_order(lambda t, q, qd: closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q))))

    def arrival(qd: Scalar) -> Scalar:
        return advance(step, 0.0, (first[None], qd[None]), FRAME_TIME, substeps=8)[0][0]

    def iteration(_, qd: Scalar) -> Scalar:
        reached, slope = jax.jvp(arrival, (qd,), (jnp.ones_like(qd),))
        return qd - (reached - second) / slope

    change = (second - first + jnp.pi) % (2 * jnp.pi) - jnp.pi
    return jax.lax.fori_loop(0, 3, iteration, change / FRAME_TIME)


@in_float64
def physical_energy(q: Float[np.ndarray, "*shape"], qd: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Energies of states, in J."""
    return np.asarray(energy(jnp.asarray(q), jnp.asarray(qd)))


@in_float64
def physical_states(pairs: Float[np.ndarray, "*shape input"]) -> tuple[np.ndarray, np.ndarray]:
    """(q, qd) at the first of two frames, in rad and rad/s, each of the shape before the pixels."""
    q, qd = _states(jnp.asarray(pairs, float).reshape(-1, 2, PIXELS))
    shape = pairs.shape[:-1]
    return np.asarray(q).reshape(shape), np.asarray(qd).reshape(shape)


@in_float64
def predict_frames(
    model: LatentModel, parameters: Parameters, pairs: Float[np.ndarray, "K input"], times: int
) -> FrameMotions:
    """The motions from two frames each, integrated adaptively in the latent plane, decoded for `times` frames."""
    parameters = with_float64(parameters)
    q, p = encoded(model, parameters, pairs)
    latent = predict(model.field, parameters["field"], q, p, np.arange(float(times)))
    return FrameMotions(latent, decoded(model, parameters, latent))


@in_float64
def encoded(
    model: LatentModel, parameters: Parameters, pairs: Float[np.ndarray, "*shape input"]
) -> tuple[np.ndarray, np.ndarray]:
    """(z_q, z_p) of pairs of frames, each [..., 1]."""
    flat = jnp.asarray(pairs, float).reshape(-1, pairs.shape[-1])
    q, p = _encoded(model, with_float64(parameters), flat)
    shape = (*pairs.shape[:-1], 1)
    return np.asarray(q).reshape(shape), np.asarray(p).reshape(shape)


@in_float64
def decoded(model: LatentModel, parameters: Parameters, latent: Motions) -> Float[np.ndarray, "K T input"]:
    """Pairs of frames of latent motions."""
    flat = (jnp.asarray(state, float).reshape(-1, 1) for state in (latent.q, latent.p))
    pairs = _decoded(model, with_float64(parameters), *flat)
    return np.asarray(pairs).reshape(*latent.q.shape[:2], -1)


def recoded(model: LatentModel, parameters: Parameters, truth: Frames) -> Float[np.ndarray, "K T input"]:
    """True pairs of frames, encoded and decoded: what the autoencoder alone makes of them."""
    return decoded(model, parameters, Motions(truth.t[:-1], *encoded(model, parameters, truth.pairs)))


def energy_errors(pairs: Float[np.ndarray, "K T input"], truth: Frames) -> Float[np.ndarray, " K"]:
    """Mean over times of (H - H_true)² for each motion, in J²; infinite for one that is not finite."""
    q, qd = physical_states(pairs)
    times = q.shape[1]
    errors = physical_energy(q, qd) - physical_energy(truth.q[:, :times], truth.qd[:, :times])
    return finite_or_infinite(np.mean(errors**2, axis=1))


def frame_errors(model: LatentModel, parameters: Parameters, test: Frames) -> tuple[dict[str, float], FrameMotions]:
    """`energy_mse` and `frame_mse`, each as by `phase_metrics.summary`, of motions from the first pairs; and these."""
    pairs = test.pairs
    moved = predict_frames(model, parameters, pairs[:, 0], pairs.shape[1])
    pictures = np.mean((moved.pairs - pairs) ** 2, axis=(1, 2))
    found = summary("energy_mse", energy_errors(moved.pairs, test)) | summary("frame_mse", pictures)
    return found, moved


@in_float64
def late_energy_errors(
    model: LatentModel, parameters: Parameters, test: Frames, *, after: int = 1000, times: int = 32
) -> Float[np.ndarray, " K"]:
    """As `energy_errors`, for `times` frames from the frame number `after` on: whether the energy drifts."""
    parameters = with_float64(parameters)
    q, p = encoded(model, parameters, test.pairs[:, 0])
    frames = np.concatenate([[0.0], after + np.arange(float(times))])
    latent = predict(model.field, parameters["field"], q, p, frames)
    late = Motions(frames[1:], latent.q[:, 1:], latent.p[:, 1:])
    found = physical_energy(*physical_states(decoded(model, parameters, late)))
    return finite_or_infinite(np.mean((found - physical_energy(test.q[:, :1], test.qd[:, :1])) ** 2, axis=1))


def energy_floor(test: Frames) -> float:
    """The estimator's own mean square error of the energy, in J², on true frames."""
    return float(np.mean(energy_errors(test.pairs, test)))


@jax.jit
def _states(pairs: Array) -> tuple[Array, Array]:
    grid = 2 * jnp.pi * jnp.arange(GRID) / GRID - jnp.pi
    drawn = jax.vmap(lambda q: render(q).ravel())(grid)

    def state(pair: Array) -> tuple[Scalar, Scalar]:
        first, second = (fitted_angle(frame, grid, drawn) for frame in pair)
        return first, velocity_between(first, second)

    return jax.lax.map(state, pairs, batch_size=_BATCH)


# Compiled once for each model, whatever its parameters.
@functools.partial(jax.jit, static_argnames=("model",))
def _encoded(model: LatentModel, parameters: Parameters, pairs: Array):
    return jax.vmap(model.apply(parameters).encode)(pairs)


@functools.partial(jax.jit, static_argnames=("model",))
def _decoded(model: LatentModel, parameters: Parameters, q: Array, p: Array):
    return jax.vmap(model.apply(parameters).decode)(q, p)
