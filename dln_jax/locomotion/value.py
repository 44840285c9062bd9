"""The learned value of an observation: the discounted rewards that a policy is expected to collect from there."""

from collections.abc import Callable
from typing import NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.locomotion.learning import Parameters

VALUE_WIDTH = 64
"""Number of units of the two hidden layers of the value."""


class Window(NamedTuple):
    """Records of one lane's window, for the value."""

    seen: Float[Array, "H_plus_1 o"]
    reward: Float[Array, " H"]
    alive: Float[Array, " H_plus_1"]
    """1 before a fall, 0 after."""


def make_value(size: int) -> tuple[Callable[[Array], Parameters], Callable[[Parameters, Array], Array]]:
    """Returns (init, apply) of the value of observations of this size."""

    def network(seen: Float[Array, " o"]) -> Float[Array, ""]:
        return hk.nets.MLP([VALUE_WIDTH, VALUE_WIDTH, 1], activation=jnp.tanh, name="value")(seen)[0]

    transformed = hk.without_apply_rng(hk.transform(network))
    return lambda key: transformed.init(key, jnp.zeros(size)), transformed.apply


def targets(window: Window, values: Float[Array, " H_plus_1"], discount: float, trace: float) -> Float[Array, " H"]:
    """Returns TD(lambda) targets G_t of a window; `values` are V' of its observations and count before a fall."""
    values = window.alive * values

    def back(later: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, value = at
        target = reward + discount * ((1 - trace) * value + trace * later)
        return target, target

    return jax.lax.scan(back, values[-1], (window.alive[:-1] * window.reward, values[1:]), reverse=True)[1]
