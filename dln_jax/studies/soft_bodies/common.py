"""What the cases of soft bodies share."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.rollout import rollout
from dln_jax.softbody.scene import Params, State
from dln_jax.softbody.step import Step
from dln_jax.solvers.info import Info

GRAVITY = 9.8
"""In m/s², of the reference values."""


class Seen(NamedTuple):
    """What is seen after each of T steps."""

    x: Float[np.ndarray, "T n dim"]
    v: Float[np.ndarray, "T n dim"]
    iterations: Int[np.ndarray, " T"]
    converged: Bool[np.ndarray, " T"]


def motion(step: Step, steps: int) -> Callable[[Params, State], Seen]:
    """(params, state) -> so many steps from there, compiled at its first call."""

    def observe(state: State, info: Info) -> tuple:
        return state.x, state.v, info.iterations, info.converged

    @jax.jit
    def program(params: Params, state: State) -> tuple:
        return rollout(functools.partial(step, params), state, steps=steps, observe=observe)[1]

    return lambda params, state: Seen(*map(np.asarray, program(params, state)))
