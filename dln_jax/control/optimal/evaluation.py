"""Returns of a policy, with the evaluation of continuous fitted value iteration (arXiv:2105.04682 and its program).

Euler's method at 250 Hz for 5 s, controls at 125 Hz, states that are not on a circle clipped to the box, and

    return = - sum of dt (q(x) + g(u)),

undiscounted, including the walls. It is the reward of the papers, so more is better.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.optimal.boxes import limits
from dln_jax.control.optimal.plants import ValuePlant
from dln_jax.control.optimal.problem import rates

RATE, SECONDS, HELD = 250.0, 5.0, 2
UP = 0.1
"""Angle in rad below which a pole counts as upright."""
Where = Literal["down", "uniform"]


class Returns(NamedTuple):
    """Returns of runs from several initial states."""

    returns: Float[np.ndarray, " N"]
    settled: Float[np.ndarray, " N"]
    """Time in s after which the pole stays upright; infinite if it is not upright at the end."""
    most: float
    """The largest control."""
    x: Float[np.ndarray, "N T n"]


def starts(plant: ValuePlant, where: Where, count: int = 100, seed: int = 0) -> Float[np.ndarray, "N n"]:
    """Random initial states, as published."""
    random, (mean, variance, widths) = np.random.default_rng(seed), plant.starts
    if where == "down":
        return np.asarray(mean) + np.sqrt(variance) * random.normal(size=(count, len(mean)))
    return random.uniform(-1, 1, (count, len(mean))) * np.asarray(widths)


def evaluate(plant: ValuePlant, law: Callable[[Array], Array], x: Any) -> Returns:
    """Returns of a law x [n] -> u [m] from states x [N, n]; NaN where it fails."""
    problem, dt = plant.problem, 1 / RATE
    low, high = limits(problem)
    field = rates(problem)

    def sample(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        x, total = carry
        u = jnp.clip(law(x), -plant.limit, plant.limit)
        for _ in range(HELD):
            total = total - dt * (problem.state_cost(x) + plant.rest + problem.action_cost.cost(u))
            x = jnp.clip(x + dt * field(x, u), low, high)
        return (x, total), (x, u)

    def run(x: Array) -> tuple[Array, Array, Array]:
        steps = round(SECONDS * RATE / HELD)
        (_, total), (later, u) = jax.lax.scan(sample, (x, jnp.zeros(())), length=steps)
        return total, jnp.concatenate([x[None], later]), u

    totals, states, controls = map(np.asarray, jax.jit(jax.vmap(run))(jnp.asarray(x, float)))
    angle = states[..., plant.angle]
    up = np.abs(np.arctan2(np.sin(angle), np.cos(angle))) < UP
    last_down = up.shape[1] - np.argmin(up[:, ::-1], axis=1)
    times = np.where(up.all(axis=1), 0.0, last_down * HELD / RATE)
    return Returns(totals, np.where(up[:, -1], times, np.inf), float(np.max(np.abs(controls))), states)
