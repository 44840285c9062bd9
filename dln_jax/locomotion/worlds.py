"""Variation between episodes: perturbed starts, slopes, rough ground and pushes. Only stated ones are traced.

A slope is a direction of gravity, exact for plane ground: x runs along the slope. Rough ground is a sum of waves of
equal amplitudes with random lengths (half a body length to two), directions and phases. A push is a jump of the
velocity of the whole body in a random horizontal direction, about every three seconds.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from dln_jax.softbody.scene import State
from dln_jax.softbody.terms.creature import Bumps, ground_height
from dln_jax.types import InputError

WAVES = 4
"""Number of waves of rough ground."""
WAVE_LENGTHS = 0.5, 2.0
"""Range of wave lengths, in body lengths."""
PUSHES = 0.01
"""Probability of a push per step."""
GRAVITY = 9.8
"""In m/s²."""


class Variation(NamedTuple):
    """Variation between episodes."""

    start: float = 0.0
    """Standard deviation of the vertices' initial positions in m; their velocities have 10/s times this deviation."""
    slope: float = 0.0
    """Largest slope in degrees; half of all slopes are this steep, and the others are uniform below."""
    rough: float = 0.0
    """Largest height of rough ground in m."""
    push: float = 0.0
    """Change of velocity by a push, in m/s."""


FLAT = Variation()


class World(NamedTuple):
    """The surroundings of an episode; `None` for absent variations."""

    gravity: Float[Array, " dim"] | None
    """In m/s²."""
    bumps: Bumps | None
    seed: Int[Array, ""] | None
    """Seed of the pushes."""
    push: Float[Array, ""] | None
    """Change of velocity by a push, in m/s."""


def require_variation(variation: Variation) -> None:
    """Raises `InputError` for negative or non-finite numbers, and for slopes of 90 degrees or more."""
    for name, value in variation._asdict().items():
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{name} is {value}; expected 0 or a positive number")
    if variation.slope >= 90:
        raise InputError(f"slope is {variation.slope} degrees; expected less than 90")


def level_world(variation: Variation, dimension: int) -> World:
    """Returns the world without slope, bumps and pushes, with placeholders for stated variations."""
    gravity = jnp.asarray([0.0] * (dimension - 1) + [-GRAVITY]) if variation.slope else None
    flat = Bumps(jnp.zeros(WAVES), jnp.zeros((WAVES, dimension - 1)), jnp.zeros(WAVES)) if variation.rough else None
    pushes = (jnp.asarray(0), jnp.asarray(0.0)) if variation.push else (None, None)
    return World(gravity, flat, *pushes)


def drawn_world(variation: Variation, key: Array, level: World, length: float, *, steepest: bool) -> World:
    """Draws a random world. `length` is the body length in m; `steepest` takes the largest slope, in a random
    direction."""
    for_slope, for_direction, for_length, for_wave, for_phase, for_push = jax.random.split(key, 6)
    gravity, bumps = level.gravity, level.bumps
    if gravity is not None:
        angle = math.radians(variation.slope)
        if not steepest:
            angle = angle * jnp.minimum(1.0, 2.0 * jax.random.uniform(for_slope))
        horizontal = _direction(for_direction, (), len(gravity) - 1)
        gravity = GRAVITY * jnp.append(jnp.sin(angle) * horizontal, -jnp.cos(angle))
    if bumps is not None:
        shortest, longest = WAVE_LENGTHS
        lengths = length * shortest * (longest / shortest) ** jax.random.uniform(for_length, (WAVES, 1))
        direction = _direction(for_wave, (WAVES,), bumps.wave_vector.shape[1])
        phase = 2 * jnp.pi * jax.random.uniform(for_phase, (WAVES,))
        bumps = Bumps(jnp.full(WAVES, variation.rough / WAVES), 2 * jnp.pi / lengths * direction, phase)
    if level.seed is None:
        return World(gravity, bumps, None, None)
    seed = jax.random.randint(for_push, (), 0, jnp.iinfo(jnp.int32).max, level.seed.dtype)
    return World(gravity, bumps, seed, jnp.asarray(variation.push))


def lifted(world: World, x: Float[Array, "n dim"]) -> Float[Array, "n dim"]:
    """Lifts a body out of rough ground."""
    bumps = world.bumps
    if bumps is None:
        return x
    depth = jax.vmap(lambda at: ground_height(bumps, at[:-1]) - at[-1])(x)
    return x.at[:, -1].add(jnp.maximum(depth.max(), 0.0))


def pushed(world: World, state: State, steps: Array) -> State:
    """Returns the state after a push, if there is one before this step."""
    if world.seed is None or world.push is None:
        return state
    whether, direction = jax.random.split(jax.random.fold_in(jax.random.key(world.seed), steps))
    horizontal = _direction(direction, (), state.v.shape[1] - 1)
    size = jnp.where(jax.random.uniform(whether) < PUSHES, world.push, 0.0)
    return state._replace(v=state.v.at[:, :-1].add(size * horizontal))


def _direction(key: Array, shape: tuple[int, ...], dimension: int) -> Float[Array, "*shape dimension"]:
    """Returns random unit vectors (signs in one dimension)."""
    drawn = jax.random.normal(key, (*shape, dimension))
    return drawn / jnp.linalg.norm(drawn, axis=-1, keepdims=True)
