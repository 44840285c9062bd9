"""The task: a creature at rest on the ground goes as far along x as it can within an episode, and does not fall.

    observation = [(x - x_rest) / (0.1 L) relative to the mean x, v / (L / 1 s), sin 2 pi t / P, cos 2 pi t / P]
    reward of a step = change of mean x / L - w posture / T
    posture = 1 - cos tilt + (max(0, 0.8 - h / h_rest) / 0.2)²

L is the creature's body length, t the time since the episode of T steps began, and P the period of the clock. Heights
are relative to the ground; along the ground only positions relative to the mean x are observed, so that all places are
equivalent. h is the mean height, and the tilt is that of the rotation which takes the rest shape nearest to the body
(Procrustes). A body that has tilted by more than 1 rad has fallen, and distance after a fall does not count: tall
bodies would go far by rolling.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh.shapes import Creature, biped, body_length, crawler, quadruped
from dln_jax.softbody.scene import SoftScene, State
from dln_jax.softbody.step import Stepper, make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.types import InputError, require_positive

CREATURES: dict[str, Callable[[], Creature]] = {"crawler": crawler, "biped": biped, "quadruped": quadruped}
EPISODE = 80
"""Steps of an episode."""
CLOCK_PERIOD = 16.0
"""Period of the clock in steps."""
SHORTEST = 0.25
"""Smallest actuation: length of a muscle relative to its rest length; the largest is 1."""
POSITION_UNIT = 0.1
"""Unit of observed positions, in body lengths."""
UPRIGHT = 4.0
"""w, in body lengths per episode."""
CROUCHED = 0.8
"""Mean height, relative to that at rest, below which crouching is penalised."""
FALLEN = 1.0
"""Tilt of a fall, in rad."""

Act = Callable[[Float[Array, " o"]], Float[Array, " k"]]
"""Observation -> actuation."""


class LocomotionTask(NamedTuple):
    """A creature with its scene and time step."""

    creature: Creature
    scene: SoftScene
    stepper: Stepper
    length: float
    """Body length in m."""
    episode: int
    """Steps."""
    clock_period: float
    """Steps."""
    upright: float
    """w of the reward, in body lengths per episode."""

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return 2 * self.creature.mesh.vertices.size + 2

    @property
    def muscle_count(self) -> int:
        """Length of an actuation."""
        return len(self.creature.muscles)


class EpisodeState(NamedTuple):
    """State of an episode."""

    state: State
    steps: Int[Array, ""]
    """Steps since its beginning."""


class Walk(NamedTuple):
    """Records of T steps."""

    x: Float[Array, "T n 2"]
    """Positions after the steps, in m."""
    actuation: Float[Array, "T k"]
    converged: Bool[Array, " T"]
    reward: Float[Array, " T"]
    """In body lengths."""
    tilt: Float[Array, " T"]
    """In rad."""


def make_task(
    creature: Creature, *, episode: int = EPISODE, clock_period: float = CLOCK_PERIOD, upright: float = UPRIGHT
) -> LocomotionTask:
    """Returns the task of a creature of the "creature" preset, with its published time step."""
    require_positive(episode=episode, clock_period=clock_period)
    scene = creature_scene(creature)
    stepper, length = make_step(scene, TIME_STEP), body_length(creature)
    return LocomotionTask(creature, scene, stepper, length, episode, clock_period, upright)


def creature_named(name: str) -> Creature:
    """Returns the creature of this name; `InputError` lists the names."""
    if name not in CREATURES:
        raise InputError(f"creature '{name}' is unknown; choose from {', '.join(CREATURES)}")
    return CREATURES[name]()


def beginning(task: LocomotionTask) -> EpisodeState:
    """Returns the creature's rest shape at rest."""
    return EpisodeState(task.stepper.init(), jnp.asarray(0))


def observe(task: LocomotionTask, place: EpisodeState) -> Float[Array, " o"]:
    """Returns the observation defined at the top of the module."""
    rest = jnp.asarray(task.creature.mesh.vertices, place.state.x.dtype)
    moved = place.state.x - rest
    moved = moved.at[:, 0].add(-moved[:, 0].mean()) / (POSITION_UNIT * task.length)
    angle = 2.0 * jnp.pi / task.clock_period * place.steps.astype(moved.dtype)
    clock = jnp.stack([jnp.sin(angle), jnp.cos(angle)])
    return jnp.concatenate([moved.ravel(), place.state.v.ravel() / task.length, clock])


def advance(task: LocomotionTask, place: EpisodeState, actuation: Float[Array, " k"]) -> tuple[EpisodeState, Walk]:
    """Returns the place after one step, and the record of the step."""
    state, info = task.stepper.step(task.scene.params, place.state, actuation)
    cost, angle = _posture(task, state.x)
    travelled = (state.x[:, 0].mean() - place.state.x[:, 0].mean()) / task.length
    reward = travelled - task.upright * cost / task.episode
    return EpisodeState(state, place.steps + 1), Walk(state.x, actuation, info.converged, reward, angle)


def walk(task: LocomotionTask, act: Act, start: EpisodeState, steps: int) -> tuple[EpisodeState, Walk]:
    """Runs a policy for a number of steps from a place."""

    def one(place: EpisodeState, _: None) -> tuple[EpisodeState, Walk]:
        return advance(task, place, act(observe(task, place)))

    return jax.lax.scan(one, start, length=steps)


class Episode(NamedTuple):
    """Results of an episode from rest; NaN if a step did not converge."""

    distance: Float[Array, ""]
    """Body lengths before a fall, if any; the criterion for policies."""
    total_reward: Float[Array, ""]
    """Reward before a fall."""


def run_episode(task: LocomotionTask, act: Act) -> Episode:
    """Runs one episode from rest."""
    return judged(task, walk(task, act, beginning(task), task.episode)[1])


def judged(task: LocomotionTask, seen: Walk) -> Episode:
    """Evaluates the steps of an episode from rest."""
    before_fall = jnp.cumsum(jnp.abs(seen.tilt) > FALLEN) == 0
    means = jnp.concatenate([beginning(task).state.x[None, :, 0], seen.x[:, :, 0]]).mean(axis=1)
    distance = (before_fall * jnp.diff(means)).sum() / task.length
    usable = jnp.where(seen.converged.all(), 1.0, jnp.nan)
    return Episode(usable * distance, usable * (before_fall * seen.reward).sum())


def chosen(condition: Any, new: Any, old: Any) -> Any:
    """Selects one of two trees of arrays."""
    return jax.tree.map(lambda new, old: jnp.where(condition, new, old), new, old)


def actuation_of(command: Float[Array, "*k"] | Float[np.ndarray, "*k"]) -> Float[Array, "*k"]:
    """Actuation in [0.25, 1] of commands, which are clipped to [-1, 1]."""
    return SHORTEST + (1.0 - SHORTEST) * 0.5 * (1.0 + jnp.clip(command, -1.0, 1.0))


def _posture(task: LocomotionTask, x: Float[Array, "n 2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Posture of the reward, and tilt in rad, positive to the left."""
    rest = jnp.asarray(task.creature.mesh.vertices, x.dtype)
    lowered = jnp.maximum(0.0, CROUCHED - x[:, 1].mean() / rest[:, 1].mean()) / (1.0 - CROUCHED)
    rest, x = rest - rest.mean(axis=0), x - x.mean(axis=0)
    along, across = jnp.sum(rest * x), jnp.sum(rest[:, 0] * x[:, 1] - rest[:, 1] * x[:, 0])
    # The norm is zero only for a body that has shrunk to a point.
    cosine = along / jnp.sqrt(along**2 + across**2)
    return 1.0 - cosine + lowered**2, jnp.arctan2(across, along)
