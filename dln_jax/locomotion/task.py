"""The task: a creature goes as far along x as it can without falling.

    observation = [((x - o) Rᵀ - rest) / (0.1 L), v Rᵀ / (L / 1 s), R u, R h (in space), actuation, c]
    actuation of a step = clip(actuation + clip(change, -0.3, 0.3), 0.25, 1)
    reward of a step = s tanh(change of mean x / (s L)) - w posture - (1 if fallen)
    posture = 1 - cos tilt + (max(0, 0.8 - y / y_rest) / 0.2)²

A policy maps the observation to the change of the muscles' actuation, which starts at 1. It sees the body in the body's
frame, so all places along the ground are equivalent. The origin o and axes R are weighted sums of the vertices:

    o = w x,    a = axes x / |axes x|,    R = rows (a, b),    b = a turned by 90 degrees          in the plane
    R = rows (a, c x a, c),    c = a x (second axis) normalised                                    in space

L is the body length, u points against gravity, and h is the horizontal direction nearest to x. c is a clock, sin and
cos of 2 pi t / P at step t; a period P of 0 leaves it out. Speeds far above s earn little, because a creature at its
highest speed falls on downhill slopes; s = 0 rewards all speeds alike. The tilt is the angle between the body's up axis
and the ground normal, and y is the mean height. A body tilted by more than 1 rad has fallen, which ends the episode.
Later distance does not count, because tall bodies would go far by rolling.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dln_jax.locomotion.worlds import (
    FLAT,
    Variation,
    World,
    drawn_world,
    level_world,
    lifted,
    pushed,
    require_variation,
)
from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh.shapes import Creature, body_length
from dln_jax.softbody.scene import Params, SoftScene, State
from dln_jax.softbody.step import Stepper, make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.types import InputError, require_positive

SHORTEST = 0.25
"""Smallest actuation: length of a muscle relative to its rest length; the largest is 1."""
LARGEST_CHANGE = 0.3
"""Largest change of an actuation in one step, as published."""
POSITION_UNIT = 0.1
"""Unit of observed positions, in body lengths."""
CROUCHED = 0.8
"""Mean height, relative to rest, below which crouching is penalised."""
FALLEN = 1.0
"""Largest tilt of a standing body, rad."""
CLOCK_PERIOD = 16.0
"""P in steps; 0 for no clock."""
FALL = 1.0
"""Cost of a fall, in body lengths of reward."""

Act = Callable[[Float[Array, " o"]], Float[Array, " k"]]
"""Observation -> change of the actuation."""


class Frame(NamedTuple):
    """Weights of the vertices in the origin and the axes of a body's frame."""

    origin: Float[np.ndarray, " n"]
    """They sum to 1."""
    axes: Float[np.ndarray, "axes n"]
    """One axis in the plane, two in space; their weights sum to 0."""


class LocomotionTask(NamedTuple):
    """A creature with its scene, time step and variation."""

    creature: Creature
    scene: SoftScene
    stepper: Stepper
    frame: Frame
    length: float
    """Body length in m."""
    episode: int
    """Number of steps of an episode."""
    upright: float
    """w of the reward, in body lengths per step."""
    speed: float
    """s of the reward, in body lengths per step; 0 for no limit."""
    variation: Variation
    clock_period: float
    """P in steps; 0 for no clock."""
    dt: float
    """Time step in s."""

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        count, dimension = self.creature.mesh.vertices.shape
        return 2 * count * dimension + dimension * (dimension - 1) + self.muscle_count + self.clock_size

    @property
    def clock_size(self) -> int:
        """Number of clock values at the end of an observation."""
        return 2 if self.clock_period else 0

    @property
    def muscle_count(self) -> int:
        """Length of an actuation."""
        return len(self.creature.muscles)


class EpisodeState(NamedTuple):
    """State of an episode."""

    state: State
    actuation: Float[Array, " k"]
    steps: Int[Array, ""]
    """Number of steps since its beginning."""
    world: World


class Walk(NamedTuple):
    """Records of T steps."""

    x: Float[Array, "T n dim"]
    """Positions after the steps, in m."""
    actuation: Float[Array, "T k"]
    converged: Bool[Array, " T"]
    travelled: Float[Array, " T"]
    """Change of mean x, in body lengths."""
    reward: Float[Array, " T"]
    """In body lengths."""
    tilt: Float[Array, " T"]
    """In rad."""

    @property
    def lost(self) -> Bool[Array, "*T"]:
        """True if the creature has fallen, or the step did not converge."""
        return (self.tilt > FALLEN) | ~self.converged


def make_task(
    creature: Creature,
    *,
    scene: SoftScene | None = None,
    dt: float = TIME_STEP,
    episode: int = 400,
    upright: float = 0.05,
    speed: float = 0.04,
    variation: Variation = FLAT,
    frame: Frame | None = None,
    clock_period: float = CLOCK_PERIOD,
) -> LocomotionTask:
    """Returns the task of a creature.

    Args:
        creature: its mesh and muscles, which the policy sees.
        scene: a scene of this mesh with your own materials, contacts and actuators. It needs a term "gravity" (slopes
            change its direction) and one actuator with a control per muscle. Default: the published material, ground
            and muscles.
        dt: time step, s (default: the published value).

    Raises:
        InputError: a number is not positive, the variation is out of range, the scene has another mesh or no gravity,
            or rough ground is combined with your own scene.
    """
    require_positive(episode=episode, dt=dt, clock_period=clock_period or 1.0)
    require_variation(variation)
    length, vertices = body_length(creature), creature.mesh.vertices
    bumps = level_world(variation, vertices.shape[1]).bumps
    if scene is None:
        scene = creature_scene(creature, bumps)
    elif scene.mesh.vertices.shape != vertices.shape or "gravity" not in scene.params.terms or bumps is not None:
        raise InputError(
            "the scene does not suit the task; expected the creature's mesh and a term 'gravity' (rough ground needs "
            "the published ground)"
        )
    frame = fitted_frame(vertices) if frame is None else frame
    stepper = make_step(scene, dt)
    return LocomotionTask(creature, scene, stepper, frame, length, episode, upright, speed, variation, clock_period, dt)


def beginning(task: LocomotionTask, key: Array | None = None, *, steepest: bool = False) -> EpisodeState:
    """Returns the rest shape at rest on level ground or, given a key, a start perturbed by the task's variation.

    With `steepest`, all slopes are the largest, up or down.
    """
    state, world = task.stepper.init(), level_world(task.variation, task.creature.mesh.dimension)
    if key is not None:
        for_world, for_x, for_v = jax.random.split(key, 3)
        world = drawn_world(task.variation, for_world, world, task.length, steepest=steepest)
        x, v = (jax.random.normal(k, state.x.shape, state.x.dtype) for k in (for_x, for_v))
        start = task.variation.start
        state = state._replace(x=lifted(world, state.x + start * x), v=state.v + 10.0 * start * v)
    return EpisodeState(state, jnp.ones(task.muscle_count, state.x.dtype), jnp.asarray(0), world)


def observe(task: LocomotionTask, place: EpisodeState) -> Float[Array, " o"]:
    """Returns the observation defined at the top of the module."""
    rest, x = jnp.asarray(task.creature.mesh.vertices, place.state.x.dtype), place.state.x
    R, rest_R = axes_of(task.frame, x), axes_of(task.frame, rest)
    moved = (x - task.frame.origin @ x) @ R.T - (rest - task.frame.origin @ rest) @ rest_R.T
    gravity = place.world.gravity
    if gravity is None:
        gravity = task.scene.params.terms["gravity"].acceleration
    up = -gravity / jnp.linalg.norm(gravity)
    directions = [R @ up]
    if len(up) == 3:
        ahead = jnp.eye(3, dtype=x.dtype)[0] - up[0] * up
        directions.append(R @ (ahead / jnp.linalg.norm(ahead)))
    parts = [moved.ravel() / (POSITION_UNIT * task.length), (place.state.v @ R.T).ravel() / task.length]
    directions.append(place.actuation)
    if task.clock_period:
        angle = 2.0 * jnp.pi / task.clock_period * place.steps.astype(x.dtype)
        directions.append(jnp.stack([jnp.sin(angle), jnp.cos(angle)]))
    return jnp.concatenate([*parts, *directions])


def advance(task: LocomotionTask, place: EpisodeState, change: Float[Array, " k"]) -> tuple[EpisodeState, Walk]:
    """Returns the state after one step, and the record of the step."""
    change = jnp.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)
    actuation = jnp.clip(place.actuation + change, SHORTEST, 1.0)
    start = pushed(place.world, place.state, place.steps)
    state, info = task.stepper.step(params_of(task, place.world), start, actuation)
    travelled = (state.x[:, 0].mean() - start.x[:, 0].mean()) / task.length
    rest = jnp.asarray(task.creature.mesh.vertices, state.x.dtype)
    # Depth of crouching, 0 to 5.
    lowered = jnp.maximum(0.0, CROUCHED - state.x[:, -1].mean() / rest[:, -1].mean()) / (1.0 - CROUCHED)
    # The body axis that points up at rest.
    cosine = axes_of(task.frame, rest)[:, -1] @ axes_of(task.frame, state.x)[:, -1]
    tilt = jnp.arccos(jnp.clip(jax.lax.stop_gradient(cosine), -1.0, 1.0))
    worth = task.speed * jnp.tanh(travelled / task.speed) if task.speed else travelled
    reward = worth - task.upright * (1.0 - cosine + lowered**2) - FALL * (tilt > FALLEN)
    after = EpisodeState(state, actuation, place.steps + 1, place.world)
    return after, Walk(state.x, actuation, info.converged, travelled, reward, tilt)


def change_of(actuation: Float[Array, " k"], command: Float[Array, " k"]) -> Float[Array, " k"]:
    """Returns the change towards the actuation of a command in [-1, 1]: 0.3 tanh((target - actuation) / 0.3).

    Learners choose a target instead of the change: the limits then bound the actuation without a flat gradient.
    """
    target = SHORTEST + (1.0 - SHORTEST) * 0.5 * (1.0 + command)
    return LARGEST_CHANGE * jnp.tanh((target - actuation) / LARGEST_CHANGE)


def params_of(task: LocomotionTask, world: World) -> Params:
    """Returns the parameters of the scene in a world."""
    terms = dict(task.scene.params.terms)
    if world.gravity is not None:
        terms["gravity"] = terms["gravity"]._replace(acceleration=world.gravity)
    if world.bumps is not None:
        terms["ground"] = terms["ground"]._replace(bumps=world.bumps)
    return task.scene.params._replace(terms=terms)


def walk(task: LocomotionTask, act: Act, start: EpisodeState, steps: int) -> tuple[EpisodeState, Walk]:
    """Runs a policy for a number of steps from a state."""

    def one(place: EpisodeState, _: None) -> tuple[EpisodeState, Walk]:
        return advance(task, place, act(observe(task, place)))

    return jax.lax.scan(one, start, length=steps)


def run_episode(
    task: LocomotionTask, act: Act, start: EpisodeState | None = None
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Runs one episode, from rest or from a start, and returns its distance and steps by `judged`."""
    return judged(walk(task, act, beginning(task) if start is None else start, task.episode)[1])


def judged(seen: Walk) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Returns the distance of an episode in body lengths and its number of steps, up to a fall.

    The distance is the criterion for policies. It is NaN if a step before a fall did not converge.
    """
    standing = jnp.cumsum(seen.tilt > FALLEN) == 0
    usable = jnp.where((seen.converged | ~standing).all(), 1.0, jnp.nan)
    return usable * jnp.sum(jnp.where(standing, seen.travelled, 0.0)), standing.sum()


def fitted_frame(vertices: Float[np.ndarray, "n dim"]) -> Frame:
    """Returns a frame of all vertices: their mean, and the images of x (and y) under the least-squares affine map."""
    count, dimension = vertices.shape
    offsets = vertices - vertices.mean(axis=0)
    return Frame(np.full(count, 1 / count), np.linalg.pinv(offsets)[: dimension - 1])


def axes_of(frame: Frame, x: Float[Array, "n dim"]) -> Float[Array, "dim dim"]:
    """Returns the rotation R into the frame, with the axes as rows."""
    a, *others = jnp.asarray(frame.axes, x.dtype) @ x
    a = a / jnp.linalg.norm(a)
    if not others:
        return jnp.stack([a, jnp.stack([-a[1], a[0]])])
    c = jnp.cross(a, others[0])
    c = c / jnp.linalg.norm(c)
    return jnp.stack([a, jnp.cross(c, a), c])
