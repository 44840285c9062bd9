"""Differential networks and ensembles of them as a model of the catalogue: value, Jacobian and Hessian at one x."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.arguments import vectors
from dln_jax.nn.activations import Activation
from dln_jax.nn.differential_mlp import Layers, init_ensemble, layer_shapes, value_jacobian_and_hessian
from dln_jax.sizes import require_network
from dln_jax.types import VectorLike, require_positive


class Derivatives(NamedTuple):
    """Derivatives at one x [n]; for an ensemble, means over its members."""

    value: Float[Array, "m"]
    jacobian: Float[Array, "m n"]
    hessian: Float[Array, "m n n"]


class FunctionModel(NamedTuple):
    """A parametric function of x."""

    init: Callable[[Array], Layers]
    """Random key -> layers, with ensemble members on the leading axis, even for one member."""
    derivatives: Callable[[Layers], Callable[[VectorLike], Derivatives]]
    """Layers -> function of x [n], which checks its argument."""


def make_differential_network(
    *, sizes: tuple[int, ...], activation: Activation, members: int, dtype: DTypeLike = jnp.float32
) -> FunctionModel:
    """Makes the model of `nn.differential_mlp`.

    Args:
        sizes: (inputs n, hidden widths ..., outputs m).
        members: number of networks in the ensemble.

    Raises:
        InputError: invalid sizes, too large a network, or no members.
    """
    require_positive(members=members)
    layer_shapes(sizes)
    require_network(width=max(sizes), depth=max(len(sizes) - 2, 1))

    def derivatives(layers: Layers) -> Callable[[VectorLike], Derivatives]:
        def function(x):
            (inputs,) = vectors(sizes[0], x=x)
            every = jax.vmap(lambda member: value_jacobian_and_hessian(member, inputs, activation=activation))(layers)
            return Derivatives(*(array.mean(axis=0) for array in every))

        return function

    return FunctionModel(lambda key: init_ensemble(key, sizes, members=members, dtype=dtype), derivatives)
