"""Ensembles of networks: layers with a leading axis of members, without a loop over them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import PRNGKeyArray

from dln_jax.nn import differential_mlp
from dln_jax.nn.differential_mlp import Layers
from dln_jax.types import InputError


def init(key: PRNGKeyArray | Array, sizes, *, members: int, **schemes) -> Layers:
    """`differential_mlp.init` for K = `members` keys: weights [K, in, out], biases [K, out]."""
    return jax.vmap(partial(differential_mlp.init, sizes=sizes, **schemes))(jax.random.split(key, members))


def mean_and_spread(network: Callable[[Layers, Array], Any], layers: Layers, x: Array) -> tuple[Any, Any]:
    """Mean and spread over K members at x [n] of all outputs of `network(layers, x)`.

    The spread is the sample standard deviation (the sum of squares over K - 1).

    `network` is a function of one member, for instance
    `partial(differential_mlp.value_jacobian_and_hessian, activation=tanh)` for the statistics of value, Jacobian and
    Hessian. The arrays of `layers` have a leading axis of members, as from `init`.

    Raises InputError for fewer than two members, which have no spread.
    """
    members = layers[0][0].shape[0]
    if members < 2:
        raise InputError(f"the ensemble has {members} member; its spread needs two or more")
    outputs = jax.vmap(network, in_axes=(0, None))(layers, x)
    mean, spread = partial(jnp.mean, axis=0), partial(jnp.std, axis=0, ddof=1)
    return jax.tree.map(mean, outputs), jax.tree.map(spread, outputs)
