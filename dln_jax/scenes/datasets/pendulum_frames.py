"""A swinging rod as small images: the renderer, and the dataset of the pixel pendulum.

The task is that of Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks", after OpenAI gym's pendulum.

The body is gym's: a uniform rod of 1 kg and 1 m that hangs from its end, in g = 10 m/s². It moves like a point mass of
3/4 kg at 2/3 m, so H = qd²/6 + 5 (1 - cos q), in J, with q = 0 hanging. There is no torque. Frames are 0.05 s apart.
Motions start at an angle drawn uniformly within ±π/6 and, as in gym, at a velocity drawn uniformly within ±1 rad/s.

A pixel at distance d from the rod's axis has the intensity exp(-(d / w)⁴), w = 0.12 m: 1 on the rod, 0 away from it,
and smooth in between and in q. The frame shows 1.6 m x 1.6 m, with the pivot in the middle, 0.4 m below its upper edge.
The published frames are gym's own images; these need no window and are differentiable.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.precision import in_float64
from dln_jax.scenes.datasets.generators import rollouts
from dln_jax.scenes.pendulums import pendulum
from dln_jax.scenes.scene import Scene
from dln_jax.types import InputError, Scalar, Vector, require_positive

SIDE = 28
"""Pixels per side."""
PIXELS = SIDE * SIDE
FRAME_TIME = 0.05
"""Time between frames in s."""
TRAJECTORIES, FRAMES = 200, 103
"""Sizes of the published dataset."""
LARGEST_ANGLE, LARGEST_VELOCITY = np.pi / 6, 1.0
"""Bounds of the initial states, in rad and rad/s."""
_LENGTH, _WIDTH, _EXTENT, _ABOVE = 1.0, 0.12, 1.6, 0.4


def rod() -> Scene:
    """Returns the point pendulum with the same motions and energies as the rod."""
    return pendulum(mass=0.75, length=2 / 3, acceleration=10.0)


def energy(q: Float[Array, "*shape"], qd: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Returns H = qd²/6 + 5 (1 - cos q) of the rod in J, in a form without cancellation near rest."""
    return qd**2 / 6 + 10 * jnp.sin(q / 2) ** 2


def render(q: Scalar) -> Float[Array, "side side"]:
    """Renders the frame [28, 28] of a rod at an angle in rad, upper row first; intensities in [0, 1]."""
    pixel = (jnp.arange(SIDE, dtype=q.dtype) + 0.5) * (_EXTENT / SIDE)
    x, y = pixel - _EXTENT / 2, _ABOVE - pixel[:, None]
    # Coordinates along and across the rod; beyond an end, the distance is that to the end.
    along = x * jnp.sin(q) - y * jnp.cos(q)
    across = x * jnp.cos(q) + y * jnp.sin(q)
    beyond = along - jnp.clip(along, 0, _LENGTH)
    square = (across**2 + beyond**2) / _WIDTH**2
    return jnp.exp(-(square**2))


class RodFrames(NamedTuple):
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


class FrameSplit(NamedTuple):
    """Three disjoint sets of trajectories: for training, model selection and the final test."""

    train: RodFrames
    validation: RodFrames
    test: RodFrames


@in_float64
def swinging_rod(seed: int = 0, *, trajectories: int = TRAJECTORIES, frames: int = FRAMES) -> RodFrames:
    """Generates the dataset; states are integrated adaptively to 1e-10 in float64.

    Raises:
        InputError: there is no trajectory, or there are fewer than three frames (a pair and its successor).
    """
    require_positive(trajectories=trajectories)
    if frames < 3:
        raise InputError(f"frames is {frames}; expected at least 3, a pair and its successor")
    random = np.random.default_rng(seed)
    q = random.uniform(-LARGEST_ANGLE, LARGEST_ANGLE, (trajectories, 1))
    qd = random.uniform(-LARGEST_VELOCITY, LARGEST_VELOCITY, (trajectories, 1))
    t = FRAME_TIME * np.arange(frames)
    q, qd = (state[..., 0] for state in rollouts(rod(), q, qd, t))
    return RodFrames(t, q, qd, images(q))


def images(q: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape pixels"]:
    """Returns frames for angles of any shape, each as one row of 784 pixels, float32."""
    with jax.enable_x64(True):
        drawn = _images(jnp.asarray(q, float).ravel())
    return np.asarray(drawn).reshape(*np.shape(q), PIXELS)


def split(data: RodFrames, *, validation_share: float = 0.1, test_share: float = 0.2, seed: int = 0) -> FrameSplit:
    """Splits trajectories by the seed, with at least one in each set.

    Raises:
        InputError: the shares leave no trajectory for training.
    """
    require_positive(validation_share=validation_share, test_share=test_share)
    count = len(data.q)
    validation, test = (max(1, round(share * count)) for share in (validation_share, test_share))
    if validation + test >= count:
        raise InputError(
            f"{count} trajectories, {validation} for validation and {test} for the test, leave none for training; "
            "make more trajectories, or lower the shares"
        )
    order = np.random.default_rng(seed).permutation(count)
    parts = np.split(order, [count - validation - test, count - test])
    return FrameSplit(*(choose(data, np.sort(part)) for part in parts))


def choose(data: RodFrames, indices: np.ndarray) -> RodFrames:
    """Selects trajectories by index."""
    return data._replace(q=data.q[indices], qd=data.qd[indices], frames=data.frames[indices])


@jax.jit
def _images(q: Vector) -> Float[Array, "d pixels"]:
    return jax.lax.map(lambda angle: render(angle).ravel(), q, batch_size=256).astype(jnp.float32)
