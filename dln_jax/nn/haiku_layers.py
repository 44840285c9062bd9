"""Layers as Haiku parameters, so that the functions of `differential_mlp` work inside `hk.transform`."""

from collections.abc import Sequence

import haiku as hk
import jax
import jax.numpy as jnp
from jax.nn.initializers import Initializer, zeros

from dln_jax.nn.differential_mlp import GLOROT, Layers, layer_shapes


def layers(
    sizes: Sequence[int],
    *,
    name: str = "differential_mlp",
    weight: Initializer = GLOROT,
    bias: Initializer = zeros,
    dtype: jax.typing.DTypeLike = float,
) -> Layers:
    """Creates or fetches, by `hk.get_parameter`, the layers of a network with `sizes` (n, width, ..., m).

    Inside a transformed function: `value_and_jacobian(layers((2, 64, 1), name="potential"), x, activation=tanh)`.
    Parameters are called `name/layer_0`, `name/layer_1`, ..., with `w` [in, out] and `b` [out], like `hk.Linear`.
    A second call with the same name makes a second network (`name_1`), as Haiku modules do: to use one network
    twice, call once and keep the result. Schemes and dtype are those of `differential_mlp.init`.

    Raises InputError for invalid `sizes`, and ValueError (Haiku's) outside `hk.transform`.
    """
    dtype = jnp.zeros((), dtype).dtype  # Haiku's own default is float32, whatever JAX's default float is.

    def parameter(kind: str, shape: tuple[int, ...], scheme: Initializer) -> jax.Array:
        return hk.get_parameter(kind, shape, dtype, init=lambda *wanted: scheme(hk.next_rng_key(), *wanted))

    result = []
    with hk.name_scope(name):
        for index, shape in enumerate(layer_shapes(sizes)):
            with hk.name_scope(f"layer_{index}"):
                result.append((parameter("w", shape, weight), parameter("b", shape[1:], bias)))
    return tuple(result)
