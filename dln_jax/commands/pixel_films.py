"""Films of a swinging rod as small images, and the errors of predicted films.

The task is that of Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks", after OpenAI gym's pendulum.

The body is gym's: a uniform rod of 1 kg and 1 m that hangs from its end, in g = 10 m/s². It moves like a point mass of
3/4 kg at 2/3 m, so H = qd²/6 + 5 (1 - cos q), in J, with q = 0 hanging. There is no torque. Frames are 0.05 s apart.
Motions start at an angle drawn uniformly within ±π/6 and, as in gym, at a velocity drawn uniformly within ±1 rad/s.

A pixel at distance d from the rod's axis has the intensity exp(-(d / w)⁴), w = 0.12 m: 1 on the rod, 0 away from it,
and smooth in between and in q. The frame shows 1.6 m x 1.6 m, with the pivot in the middle, 0.4 m below its upper edge.
The published frames are gym's own images; these need no window and are differentiable.

Errors of predicted films are those of the physical state, and of its energy, estimated from the images:

    q       argmin |render(q) - frame|², on a grid and then by Gauss-Newton
    qd      such that the rod moves from the first frame's q to the second's in the time between them
    energy  mean over starts and times of (H(q, qd) - H(q_true, qd_true))², in J²

The velocity comes from the rod's own motion instead of a difference quotient, so that true frames have the true energy
up to the estimator's error, the `energy_floor`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.mechanics.dynamics import Flow
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.integrators import advance, rk4, rollout, second_order
from dln_jax.metrics.phase_space import Motions, finite_or_infinite, predict, summary
from dln_jax.metrics.verdict import Verdict, judge_motions
from dln_jax.models.latent_phase import ImageModel
from dln_jax.precision import in_float64, with_float64
from dln_jax.scenes.datasets.generators import rollouts
from dln_jax.scenes.pendulums import pendulum
from dln_jax.scenes.scene import Scene, closed_form_forward_dynamics
from dln_jax.types import Hamiltonian, InputError, Scalar, Vector

SIDE = 28
"""Pixels per side."""
PIXELS = SIDE * SIDE
FRAME_TIME = 0.05
"""Time between frames in s."""
TRAJECTORIES, FRAMES = 200, 103
"""Sizes of the published dataset."""
VALIDATION, TEST = 0.1, 0.2
"""Shares of the trajectories for model selection and for the test."""
LARGEST_ANGLE, LARGEST_VELOCITY = np.pi / 6, 1.0
"""Bounds of the initial states, in rad and rad/s."""
LENGTH, WIDTH, EXTENT, ABOVE = 1.0, 0.12, 1.6, 0.4
"""Length and width of the rod, side of the frame, and height of its upper edge over the pivot, in m."""
GRID = 180
"""Number of initial angles of the search, around the circle; a Gauss-Newton step is at most their distance."""
ITERATIONS = 20
INJECTED = 50
"""Frames before and after the energy of a motion is raised."""
LATE = 1000 + np.arange(32.0)
"""Frame numbers of late predictions."""


def rod() -> Scene:
    """Returns the point pendulum with the same motions and energies as the rod."""
    return pendulum(mass=0.75, length=2 / 3, acceleration=10.0)


def energy(q: Float[np.ndarray, "*shape"], qd: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Returns H = qd²/6 + 5 (1 - cos q) of the rod in J, in a form without cancellation near rest."""
    return qd**2 / 6 + 10 * np.sin(q / 2) ** 2


def render(q: Scalar) -> Float[Array, " pixels"]:
    """Renders the frame of a rod at an angle in rad, row by row from above; intensities in [0, 1]."""
    pixel = (jnp.arange(SIDE, dtype=q.dtype) + 0.5) * (EXTENT / SIDE)
    x, y = pixel - EXTENT / 2, ABOVE - pixel[:, None]
    # Coordinates along and across the rod; beyond an end, the distance is that to the end.
    along = x * jnp.sin(q) - y * jnp.cos(q)
    across = x * jnp.cos(q) + y * jnp.sin(q)
    beyond = along - jnp.clip(along, 0, LENGTH)
    square = (across**2 + beyond**2) / WIDTH**2
    return jnp.exp(-(square**2)).ravel()


class Films(NamedTuple):
    """Motions of the rod, as states and as images."""

    t: Float[np.ndarray, " T"]
    """s."""
    q: Float[np.ndarray, "K T"]
    """rad."""
    qd: Float[np.ndarray, "K T"]
    """rad/s."""
    frames: Float[np.ndarray, "K T pixels"]
    """float32, row by row."""

    @property
    def pairs(self) -> Float[np.ndarray, "K pairs input"]:
        """Pairs of successive frames [K, T - 1, 2 * 784], the input of an autoencoder: one frame shows no velocity."""
        return np.concatenate([self.frames[:, :-1], self.frames[:, 1:]], axis=2)


@in_float64
def swinging_rod(trajectories: int = TRAJECTORIES, frames: int = FRAMES) -> list[Films]:
    """Generates the dataset: disjoint films for training, model selection and the test, always the same.

    States are integrated adaptively to 1e-10 in float64.

    Raises:
        InputError: there are fewer than three trajectories.
    """
    if trajectories < 3:
        raise InputError(f"trajectories is {trajectories}; training, validation and test need at least 3")
    random = np.random.default_rng(0)
    q = random.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, (trajectories, 1))
    qd = random.uniform(-LARGEST_VELOCITY, LARGEST_VELOCITY, (trajectories, 1))
    t = FRAME_TIME * np.arange(frames)
    q, qd = (state[..., 0] for state in rollouts(rod(), q, qd, t))
    data = q, qd, np.asarray(_films(jnp.asarray(q.ravel()))).reshape(*q.shape, PIXELS)
    validation, test = (max(1, round(share * trajectories)) for share in (VALIDATION, TEST))
    order = np.random.default_rng(0).permutation(trajectories)
    parts = np.split(order, [trajectories - validation - test, trajectories - test])
    return [Films(t, *(array[np.sort(part)] for array in data)) for part in parts]


@jax.jit
def _films(q: Vector) -> Float[Array, "d pixels"]:
    return jax.lax.map(render, q, batch_size=256).astype(jnp.float32)


@in_float64
def physical_states(pairs: Float[np.ndarray, "*shape input"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns (q, qd) at the first of two frames, in rad and rad/s, without the pixel axis."""
    q, qd = _states(jnp.asarray(pairs, float).reshape(-1, 2, PIXELS))
    shape = pairs.shape[:-1]
    return np.asarray(q).reshape(shape), np.asarray(qd).reshape(shape)


@jax.jit
def _states(pairs: Float[Array, "N 2 pixels"]) -> tuple[Array, Array]:
    grid = 2 * jnp.pi * jnp.arange(GRID) / GRID - jnp.pi
    drawn = jax.vmap(render)(grid)

    def angle(frame: Float[Array, " pixels"]) -> Scalar:
        spacing = 2 * jnp.pi / GRID

        def iteration(_, q: Scalar) -> Scalar:
            image, slope = jax.jvp(render, (q,), (jnp.ones_like(q),))
            return q + jnp.clip(slope @ (frame - image) / (slope @ slope), -spacing, spacing)

        start = grid[jnp.argmin(jnp.sum(drawn**2, axis=1) - 2 * drawn @ frame)]
        return jax.lax.fori_loop(0, ITERATIONS, iteration, start)

    def state(pair: Float[Array, "2 pixels"]) -> tuple[Scalar, Scalar]:
        first, second = (angle(frame) for frame in pair)
        return first, velocity_between(first, second)

    return jax.lax.map(state, pairs, batch_size=256)


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


@functools.partial(jax.jit, static_argnames=("function", "model"))
def apply(function: str, model: ImageModel, parameters: Any, *arrays: Any) -> Any:
    """Applies "encode" or "decode" of a model to arrays [K, T, n]; compiled once per model, for all parameters."""
    return jax.vmap(jax.vmap(getattr(model.images(parameters), function)))(*arrays)


def energy_errors(pairs: Float[np.ndarray, "K T input"], true: Float[np.ndarray, "K T"]) -> Float[np.ndarray, " K"]:
    """Returns the mean over time of (H - H_true)² of films in J²; infinite for films that are not finite."""
    return finite_or_infinite(np.mean((energy(*physical_states(pairs)) - true) ** 2, axis=1))


@in_float64
def film_errors(model: ImageModel, parameters: Any, test: Films) -> tuple[dict[str, float], np.ndarray]:
    """Predicts films [K, T - 1, 2 * 784] from the first pair of frames of each test film, and measures them.

    By `summary`: `energy_mse`, `frame_mse`, and `late_energy_mse` of the `LATE` frames, which shows a drift. Besides,
    `autoencoder_energy_mse` of true pairs that are encoded and decoded, and `energy_floor` of true pairs.
    """
    parameters, pairs = with_float64(parameters), test.pairs
    move = functools.partial(predict, model.field, parameters["parameters"]["field"])
    q, p = apply("encode", model, parameters, pairs)
    moved = move(q[:, 0], p[:, 0], np.arange(float(pairs.shape[1])))
    later = move(q[:, 0], p[:, 0], np.concatenate([[0.0], LATE]))
    states = (moved.q, moved.p), (q, p), (later.q[:, 1:], later.p[:, 1:])
    films, recoded, late = (np.asarray(apply("decode", model, parameters, *state)) for state in states)
    true = energy(test.q, test.qd)[:, :-1]
    return {
        **summary("energy_mse", energy_errors(films, true)),
        **summary("frame_mse", np.mean((films - pairs) ** 2, axis=(1, 2))),
        "autoencoder_energy_mse": float(np.mean(energy_errors(recoded, true))),
        **summary("late_energy_mse", energy_errors(late, true[:, :1])),
        "energy_floor": float(np.mean(energy_errors(pairs, true))),
    }, films


def judge_films(pairs: Float[np.ndarray, "K T input"], test: Films) -> Verdict:
    """The verdict on predicted films by the rod's motions (q, qd) in them; a start is a pair of frames."""
    # Angles in images are known up to turns.
    predicted, truth = (
        Motions(test.t[:-1], np.sin(q)[..., None], qd[..., None])
        for q, qd in (physical_states(pairs), (test.q[:, :-1], test.qd[:, :-1]))
    )
    size = np.array([truth.q.std(), truth.p.std()])
    return judge_motions([predicted], [truth], size=size, bounded=np.ones(2, bool), fitted=2)


def raise_energy(H: Hamiltonian, q: Vector, p: Vector, wanted: Scalar) -> tuple[Vector, Vector]:
    """Moves (q, p) to H = wanted along dz/ds = grad H / |grad H|², which adds s to H where the gradient is not zero."""

    def direction(state: tuple[Vector, Vector]) -> tuple[Vector, Vector]:
        slopes = jax.grad(H, argnums=(0, 1))(*state)
        square = sum(jnp.sum(slope**2) for slope in slopes)
        return slopes[0] / square, slopes[1] / square

    levels = jnp.linspace(0.0, 1.0, 21) * (wanted - H(q, p))
    ascent = rollout(rk4(lambda s, state: direction(state)), (q, p), levels)
    state = ascent[0][-1], ascent[1][-1]
    for _ in range(3):  # what the integration left
        slopes, missing = direction(state), wanted - H(*state)
        state = state[0] + missing * slopes[0], state[1] + missing * slopes[1]
    return state


@in_float64
def inject_energy(
    model: ImageModel, parameters: Any, pair: Float[np.ndarray, " input"], factor: float
) -> tuple[np.ndarray, ...]:
    """Predicts the motion from two frames, then for the same time with `factor` times the energy.

    Returns times in s (that of the injection occurs twice), latent q and p, pairs of frames [T, input], the latent H
    above rest relative to its initial value, and the energy estimated from the frames in J.

    H is relative to the rod at rest, whose latent state is the encoding of two frames of the hanging rod.

    Raises:
        InputError: the model has no energy.
    """
    parameters = with_float64(parameters)
    field = flow(model.field.energies(parameters["parameters"]["field"]))
    if not isinstance(field, Flow):
        raise InputError("the model has no energy to raise; give one whose latent field is a black-box-hnn")
    H = field.energy
    still = np.tile(_films(jnp.zeros(1))[0], 2)
    q, p = (state[0] for state in apply("encode", model, parameters, np.stack([pair, still])[None]))
    first, ground = jax.vmap(H)(q, p)
    t = np.arange(float(INJECTED))
    move = functools.partial(predict, model.field, parameters["parameters"]["field"])
    before = move(q[:1], p[:1], t)
    ascend = jax.jit(functools.partial(raise_energy, H))
    wanted = ground + factor * (first - ground)
    q_raised, p_raised = ascend(jnp.asarray(before.q[0, -1]), jnp.asarray(before.p[0, -1]), wanted)
    after = move(q_raised[None], p_raised[None], t)
    q, p = (np.concatenate(halves, axis=1) for halves in ((before.q, after.q), (before.p, after.p)))
    pairs = np.asarray(apply("decode", model, parameters, q, p)[0])
    level = np.asarray((jax.vmap(H)(q[0], p[0]) - ground) / (first - ground))
    times = FRAME_TIME * np.concatenate([t, t[-1] + t])
    return times, q[0, :, 0], p[0, :, 0], pairs, level, energy(*physical_states(pairs))
