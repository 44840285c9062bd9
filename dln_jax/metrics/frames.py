"""Errors of motions predicted as images: estimates the physical state, and its energy, from the images.

    q       argmin |render(q) - frame|², on a grid and then by Gauss-Newton
    qd      such that the rod moves from the first frame's q to the second's in the time between them
    energy  mean over starts and times of (H(q, qd) - H(q_true, qd_true))², in J²

The velocity comes from the rod's own motion instead of a difference quotient, so that true frames have the true energy
up to the estimator's error, which `energy_floor` measures.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.mechanics.dynamics import Flow
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.integrators import advance, rk4, rollout, second_order
from dln_jax.metrics.phase_space import Motions, finite_or_infinite, predict, summary
from dln_jax.models.latent_phase import LatentModel
from dln_jax.models.model import Parameters
from dln_jax.precision import in_float64, with_float64
from dln_jax.scenes.datasets.pendulum_frames import FRAME_TIME, PIXELS, RodFrames, energy, images, render, rod
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.types import Hamiltonian, InputError, Scalar, Vector, require_positive

GRID = 180
"""Number of initial angles of the search, around the circle; a Gauss-Newton step is at most their distance."""
ITERATIONS = 20
LATE = 1000 + np.arange(32.0)
"""Frame numbers of late predictions."""
_BATCH, _ASCENT, _CORRECTIONS = 256, 20, 3


class FrameMotions(NamedTuple):
    """K predicted motions."""

    latent: Motions
    """Latent motions by frame number; z_q as q and z_p as p."""
    pairs: Float[np.ndarray, "K T input"]
    """Two decoded frames per time."""

    @property
    def frames(self) -> Float[np.ndarray, "K T pixels"]:
        """The first frames of the pairs."""
        return self.pairs[..., : self.pairs.shape[-1] // 2]


def fitted_angle(frame: Float[Array, " pixels"], grid: Float[Array, " G"], drawn: Float[Array, "G pixels"]) -> Scalar:
    """Returns q of a frame, in rad, starting from the best angle of a grid with known frames."""
    spacing = 2 * jnp.pi / GRID

    def iteration(_, q: Scalar) -> Scalar:
        image, slope = jax.jvp(lambda q: render(q).ravel(), (q,), (jnp.ones_like(q),))
        return q + jnp.clip(slope @ (frame - image) / (slope @ slope), -spacing, spacing)

    start = grid[jnp.argmin(jnp.sum(drawn**2, axis=1) - 2 * drawn @ frame)]
    return jax.lax.fori_loop(0, ITERATIONS, iteration, start)


def velocity_between(first: Scalar, second: Scalar) -> Scalar:
    """Returns qd at the first of two angles, in rad/s, with which the rod reaches the second within one frame."""
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
    """Returns the energies of states, in J."""
    return np.asarray(energy(jnp.asarray(q), jnp.asarray(qd)))


@in_float64
def physical_states(pairs: Float[np.ndarray, "*shape input"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns (q, qd) at the first of two frames, in rad and rad/s, without the pixel axis."""
    q, qd = _states(jnp.asarray(pairs, float).reshape(-1, 2, PIXELS))
    shape = pairs.shape[:-1]
    return np.asarray(q).reshape(shape), np.asarray(qd).reshape(shape)


@in_float64
def predict_frames(
    model: LatentModel, parameters: Parameters, pairs: Float[np.ndarray, "K input"], times: int
) -> FrameMotions:
    """Predicts motions from pairs of frames: integrates adaptively in the latent plane and decodes `times` frames."""
    parameters = with_float64(parameters)
    latent = predict(model.field, parameters["field"], *encoded(model, parameters, pairs), np.arange(float(times)))
    return FrameMotions(latent, decoded(model, parameters, latent))


@in_float64
def encoded(
    model: LatentModel, parameters: Parameters, pairs: Float[np.ndarray, "*shape input"]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns (z_q, z_p) of pairs of frames, both [..., 1]."""
    flat = jnp.asarray(pairs, float).reshape(-1, pairs.shape[-1])
    q, p = _applied("encode", model, with_float64(parameters), flat)
    shape = (*pairs.shape[:-1], 1)
    return np.asarray(q).reshape(shape), np.asarray(p).reshape(shape)


@in_float64
def decoded(model: LatentModel, parameters: Parameters, latent: Motions) -> Float[np.ndarray, "K T input"]:
    """Returns the pairs of frames of latent motions."""
    states = (jnp.asarray(state, float).reshape(-1, 1) for state in (latent.q, latent.p))
    pairs = _applied("decode", model, with_float64(parameters), *states)
    return np.asarray(pairs).reshape(*latent.q.shape[:2], -1)


def recoded(model: LatentModel, parameters: Parameters, truth: RodFrames) -> Float[np.ndarray, "K T input"]:
    """Encodes and decodes true pairs of frames, which shows the error of the autoencoder alone."""
    return decoded(model, parameters, Motions(truth.t[:-1], *encoded(model, parameters, truth.pairs)))


def energy_errors(pairs: Float[np.ndarray, "K T input"], truth: RodFrames) -> Float[np.ndarray, " K"]:
    """Returns the mean over time of (H - H_true)² of the motions in J²; infinite for motions that are not finite."""
    q, qd = physical_states(pairs)
    true = physical_energy(truth.q, truth.qd)[:, : q.shape[1]]
    return finite_or_infinite(np.mean((physical_energy(q, qd) - true) ** 2, axis=1))


def frame_errors(model: LatentModel, parameters: Parameters, test: RodFrames) -> tuple[dict[str, float], FrameMotions]:
    """Predicts motions from the first pairs; returns `energy_mse` and `frame_mse` by `summary`, and the motions."""
    pairs = test.pairs
    moved = predict_frames(model, parameters, pairs[:, 0], pairs.shape[1])
    images = np.mean((moved.pairs - pairs) ** 2, axis=(1, 2))
    return summary("energy_mse", energy_errors(moved.pairs, test)) | summary("frame_mse", images), moved


@in_float64
def late_energy_errors(model: LatentModel, parameters: Parameters, test: RodFrames) -> Float[np.ndarray, " K"]:
    """Returns the `energy_errors` of the `LATE` frames, which show energy drift."""
    parameters = with_float64(parameters)
    frames = np.concatenate([[0.0], LATE])
    latent = predict(model.field, parameters["field"], *encoded(model, parameters, test.pairs[:, 0]), frames)
    late = Motions(frames[1:], latent.q[:, 1:], latent.p[:, 1:])
    predicted = physical_energy(*physical_states(decoded(model, parameters, late)))
    return finite_or_infinite(np.mean((predicted - physical_energy(test.q[:, :1], test.qd[:, :1])) ** 2, axis=1))


def energy_floor(test: RodFrames) -> float:
    """Returns the mean squared error of the energy estimate on true frames, in J²."""
    return float(np.mean(energy_errors(test.pairs, test)))


class Injection(NamedTuple):
    """One motion with `times` frames before and `times` frames after its energy is raised."""

    latent: Motions
    """One motion [1, 2 times, 1] by frame number, with both states at the moment of injection."""
    pairs: Float[np.ndarray, "T input"]
    level: Float[np.ndarray, " T"]
    """Latent H above rest, relative to its initial value."""
    physical: Float[np.ndarray, " T"]
    """Energy estimated from the frames, in J."""


def raise_energy(H: Hamiltonian, q: Vector, p: Vector, wanted: Scalar) -> tuple[Vector, Vector]:
    """Moves (q, p) to H = wanted along dz/ds = grad H / |grad H|², which adds s to H where the gradient is not zero."""

    def direction(state: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        slopes = jax.grad(H, argnums=(0, 1))(*state)
        square = sum(jnp.sum(slope**2) for slope in slopes)
        return slopes[0] / square, slopes[1] / square

    levels = jnp.linspace(0.0, 1.0, _ASCENT + 1) * (wanted - H(q, p))
    ascent = rollout(rk4(lambda s, state: direction(state)), (q, p), levels)
    state = ascent[0][-1], ascent[1][-1]
    for _ in range(_CORRECTIONS):
        slopes, missing = direction(state), wanted - H(*state)
        state = state[0] + missing * slopes[0], state[1] + missing * slopes[1]
    return state


@in_float64
def inject_energy(
    model: LatentModel,
    parameters: Parameters,
    pair: Float[np.ndarray, " input"],
    *,
    factor: float = 2.0,
    times: int = 50,
) -> Injection:
    """Predicts the motion from two frames, with `factor` times the energy from frame number `times` on.

    H is relative to the rod at rest, whose latent state is the encoding of two frames of the hanging rod.

    Raises:
        InputError: the model has no energy, or a factor or `times` is not positive.
    """
    require_positive(factor=factor, times=times)
    parameters = with_float64(parameters)
    field = flow(model.field.energies(parameters["field"]))
    if not isinstance(field, Flow):
        raise InputError("the model has no energy to raise; give one whose latent field is a black-box-hnn")
    H = field.energy
    still = np.tile(images(np.zeros(1))[0], 2)
    q, p = encoded(model, parameters, np.stack([pair, still]))
    start, ground = (H(jnp.asarray(state), jnp.asarray(momentum)) for state, momentum in zip(q, p, strict=True))
    start, t = start - ground, np.arange(float(times))
    before = predict(model.field, parameters["field"], q[:1], p[:1], t)
    ascend = jax.jit(functools.partial(raise_energy, H))
    q_raised, p_raised = ascend(jnp.asarray(before.q[0, -1]), jnp.asarray(before.p[0, -1]), ground + factor * start)
    after = predict(model.field, parameters["field"], np.asarray(q_raised)[None], np.asarray(p_raised)[None], t)
    q, p = (np.concatenate(halves, axis=1) for halves in ((before.q, after.q), (before.p, after.p)))
    latent = Motions(np.concatenate([t, t[-1] + t]), q, p)
    pairs = decoded(model, parameters, latent)[0]
    levels = jax.vmap(H)(jnp.asarray(latent.q[0]), jnp.asarray(latent.p[0]))
    return Injection(latent, pairs, np.asarray((levels - ground) / start), physical_energy(*physical_states(pairs)))


@jax.jit
def _states(pairs: Array) -> tuple[Array, Array]:
    grid = 2 * jnp.pi * jnp.arange(GRID) / GRID - jnp.pi
    drawn = jax.vmap(lambda q: render(q).ravel())(grid)

    def state(pair: Array) -> tuple[Scalar, Scalar]:
        first, second = (fitted_angle(frame, grid, drawn) for frame in pair)
        return first, velocity_between(first, second)

    return jax.lax.map(state, pairs, batch_size=_BATCH)


# Compiled once per model, for all parameters.
@functools.partial(jax.jit, static_argnames=("model", "function"))
def _applied(function: str, model: LatentModel, parameters: Parameters, *arrays: Array):
    return jax.vmap(getattr(model.apply(parameters), function))(*arrays)
