"""What a caller gives as one state: converted to vectors of one floating type, or refused in one line.

This is for the edge, where functions are handed out; the mechanics behind it checks nothing. Shapes are static, so that
a compiled function pays nothing for it.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array

from dln_jax.types import InputError


def vectors(size: int | None = None, /, **given: Any) -> tuple[Array, ...]:
    """The arguments as vectors [size] of one floating type, in the order given.

    The type is the widest floating one among them, and JAX's own for whole numbers.

    Args:
        size: of each; without it, whatever the first one has.
        given: by their names, anything; `types.VectorLike` is what passes.

    Raises:
        InputError: names the argument that holds no real numbers, or has another shape; a batch is for `jax.vmap`.
    """
    arrays = {name: _real_array(name, value) for name, value in given.items()}
    expected = None if size is None else (size,)
    for name, array in arrays.items():
        require_shape(name, array.shape, expected)
        expected = array.shape
    common = jnp.result_type(float, *arrays.values())
    return tuple(array.astype(common) for array in arrays.values())


def require_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...] | None) -> None:
    """Raises `InputError` unless an argument has this shape, or, for `None`, is a vector of some length."""
    if len(shape) == 1 and shape[0] > 0 if expected is None else shape == expected:
        return
    wanted = "[d]" if expected is None else str(expected)
    raise InputError(f"{name} has shape {shape}; expected {wanted}, and jax.vmap for a batch")


def _real_array(name: str, value: Any) -> Array:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        kind = "None" if value is None else f"a {type(value).__name__} that makes no array"
        raise InputError(f"{name} is {kind}; expected one vector of real numbers") from error
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise InputError(f"{name} has type {array.dtype}; expected one vector of real numbers")
    return array
