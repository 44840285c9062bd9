"""The box of states of a value function: its angles, its limits, and random states in it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.problem import ControlProblem


def circles(problem: ControlProblem) -> np.ndarray:
    """Mask of the n coordinates that are angles on a circle."""
    on_circle = np.array(problem.joints) == "revolute"
    return np.concatenate([on_circle, np.zeros(len(problem.low) - len(on_circle), bool)])


def limits(problem: ControlProblem) -> tuple[np.ndarray, np.ndarray]:
    """Returns the box, without limits for angles on a circle."""
    angles = circles(problem)
    return np.where(angles, -np.inf, problem.low), np.where(angles, np.inf, problem.high)


def uniform(problem: ControlProblem, key: Array, samples: int) -> Float[Array, "samples n"]:
    """Random states, uniform in the box."""
    low, high = jnp.asarray(problem.low, float), jnp.asarray(problem.high, float)
    return jax.random.uniform(key, (samples, len(low)), low.dtype, low, high)


def widened(problem: ControlProblem, factor: float) -> ControlProblem:
    """Returns the problem in a box that is `factor` times as wide."""
    low, high = np.asarray(problem.low), np.asarray(problem.high)
    middle, half = (low + high) / 2, factor * (high - low) / 2
    straight = ~circles(problem)
    return problem._replace(low=np.where(straight, middle - half, low), high=np.where(straight, middle + half, high))


def drawn(problem: ControlProblem, key: Array, count: int) -> Float[Array, "N n"]:
    """Random states, half of them uniform in the box, half in boxes shrunk by a uniformly distributed factor.

    Angles on a circle are uniform in both. In a box of several dimensions nearly all uniform states are far from rest,
    where motions rarely are.
    """
    of_box, of_share = jax.random.split(key)
    goal = jnp.asarray(problem.goal, float)
    x = uniform(problem, of_box, count)
    share = jnp.where(jnp.arange(count) % 2 == 0, 1.0, jax.random.uniform(of_share, (count,)))
    return jnp.where(circles(problem), x, goal + share[:, None] * (x - goal))
