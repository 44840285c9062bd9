"""The policy that gradients and evolution train: one hidden layer, actuation by a sigmoid.

    h = tanh(W_b body + W_c clock + b),    actuation = 0.25 + 0.75 sigmoid(W_a h + b_a + 1)

Layers start with variances 0.3, 1 and 1 over their fan-in: initially the clock has more influence than the body.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.locomotion.task import SHORTEST, Task, beginning, observe
from dln_jax.sizes import require_network

WIDTH = 32
_CLOCK = 2

Parameters = Any


class Policy(NamedTuple):
    """Policy as an (init, apply) pair."""

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    apply: Callable[[Parameters, Float[Array, " o"]], Float[Array, " k"]]
    """Observation -> actuation."""


def make_policy(task: Task, *, width: int = WIDTH) -> Policy:
    """Returns the policy of a task."""
    require_network(width=width, depth=1)

    def network(observation: Float[Array, " o"]) -> Float[Array, " k"]:
        body, clock = observation[:-_CLOCK], observation[-_CLOCK:]
        scaled = hk.initializers.VarianceScaling
        from_body = hk.Linear(width, w_init=scaled(0.3), name="body")(body)
        from_clock = hk.Linear(width, with_bias=False, w_init=scaled(1.0), name="clock")(clock)
        muscles = hk.Linear(task.muscle_count, w_init=scaled(1.0), name="muscles")
        return SHORTEST + (1.0 - SHORTEST) * jax.nn.sigmoid(muscles(jnp.tanh(from_body + from_clock)) + 1.0)

    transformed = hk.without_apply_rng(hk.transform(network))
    return Policy(lambda key: transformed.init(key, observe(task, beginning(task))), transformed.apply)
