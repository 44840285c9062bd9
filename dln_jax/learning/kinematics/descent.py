"""Levenberg-Marquardt on joint frames, a few iterations in one program."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from dln_jax.compilation import quick_compilation
from dln_jax.learning.kinematics.frames import Frames, displaced, free_directions
from dln_jax.learning.kinematics.projection import Projection, Samples, Structure, project

LENGTH = 0.3
"""Length in m that weighs as much as a radian in the damping."""
LARGEST_STEP = 0.6
"""Largest step of a coordinate, in rad, and in units of `LENGTH` for positions: longer steps are scaled down."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-12, 1e3
"""Initial, smallest and largest damping, relative to the mean of the normal matrix' diagonal; a descent ends at the
largest."""
FEWER, MORE = 0.2, 5.0
"""Factors of the damping after a step that descends, and after one that does not."""
CHUNK = 10
"""Iterations per dispatch."""
SETTLED = 1e-4
"""A descent ends when the loss decreases by less than this fraction over a chunk."""


class State(NamedTuple):
    """State of a descent."""

    frames: Frames
    at: Projection
    damping: Any


Program = Callable[[State, Samples, Array], State]
"""(state, samples, scales of the joints' torques) -> the state after `CHUNK` iterations."""


def compiled(structure: Structure, *, ridge: float) -> Program:
    """Returns the program of a structure; it compiles once per number of samples."""
    places = free_directions(structure.parents, structure.joints)
    lengths = np.where(places % 6 < 3, 1.0, LENGTH)
    d = len(structure.joints)

    def iteration(state: State, samples: Samples, unit: Array) -> State:
        normal = state.at.normal
        typical = jnp.trace(normal) / len(places)
        damped = normal + state.damping * typical * jnp.diag(lengths**-2.0)
        step = jnp.linalg.solve(damped, state.at.slope)
        longest = jnp.max(jnp.abs(step) / lengths)
        step = step * jnp.minimum(1.0, LARGEST_STEP / jnp.maximum(longest, LARGEST_STEP))
        frames = displaced(state.frames, jnp.zeros(6 * d).at[places].set(step).reshape(d, 6))
        at = project(structure, frames, samples, unit, ridge=ridge)
        lower = at.loss < state.at.loss  # false for NaN
        damping = jnp.clip(state.damping * jnp.where(lower, FEWER, MORE), LEAST_DAMPING, MOST_DAMPING)
        before = (state.frames, state.at)
        frames, at = jax.tree.map(lambda new, old: jnp.where(lower, new, old), (frames, at), before)
        return State(frames, at, damping)

    def iterate(state: State, samples: Samples, unit: Array) -> State:
        return lax.fori_loop(0, CHUNK, lambda _, state: iteration(state, samples, unit), state)

    return jax.jit(iterate, compiler_options=quick_compilation())


def unseen(frames: Frames, linear: int, directions: int) -> State:
    """Returns a state from which the first iteration only evaluates the frames, without a step."""
    d = len(frames.positions)
    at = Projection(
        loss=jnp.asarray(jnp.inf),
        squares=jnp.zeros(d),
        linear=jnp.zeros(linear),
        normal=jnp.eye(directions),
        slope=jnp.zeros(directions),
    )
    return State(jax.tree.map(jnp.asarray, frames), at, jnp.asarray(FIRST_DAMPING / FEWER))


def descend(
    program: Program,
    structure: Structure,
    frames: Frames,
    samples: Samples,
    unit: Any,
    *,
    iterations: int,
    expired: Callable[[], bool] = lambda: False,
) -> State:
    """Iterates until the loss settles, no step descends, or the iterations or the time are used up."""
    samples, unit = jax.tree.map(jnp.asarray, samples), jnp.asarray(unit)
    directions = len(free_directions(structure.parents, structure.joints))
    state = unseen(frames, structure.linear_count, directions)
    before = np.inf
    for _ in range(0, iterations, CHUNK):
        state = program(state, samples, unit)
        now = float(state.at.loss)
        if not now < before * (1 - SETTLED) or float(state.damping) >= MOST_DAMPING or expired():
            break
        before = now
    return state
