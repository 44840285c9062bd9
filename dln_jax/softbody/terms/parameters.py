"""What users pass to the factories of terms: vertex lists, and material values for all elements or for each.

Values are checked where the scene is built. Inside a transformation (a scene built under `jit` or `grad`) they are
unknown and pass unchecked, as do those that later replace the defaults.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from dln_jax.types import InputError

Numbers = ArrayLike | Sequence[float | int]
Indices = ArrayLike | Sequence[int | np.integer] | Sequence[Sequence[int | np.integer]]


class Bound(NamedTuple):
    """Which values are accepted."""

    holds: Callable[[np.ndarray], np.ndarray]
    """Elementwise; false for NaN."""
    expected: str
    """In words."""


POSITIVE = Bound(lambda values: (values > 0) & np.isfinite(values), "a positive number")
NOT_NEGATIVE = Bound(lambda values: (values >= 0) & np.isfinite(values), "zero or a positive number")


def material(
    name: str, value: Numbers, count: int, element: str, bound: Bound = POSITIVE
) -> Float[Array, ""] | Float[Array, " m"]:
    """A value for all elements [] or one for each [m]; `InputError` names the first element that has a wrong one."""
    result = jnp.asarray(value, dtype=float)
    if result.shape not in ((), (count,)):
        raise InputError(f"{name} has shape {result.shape}; expected one number, or {count}: one per {element}")
    if not isinstance(result, Tracer):
        wrong = np.flatnonzero(~bound.holds(np.atleast_1d(np.asarray(result))))
        if wrong.size:
            where = f" of {element} {wrong[0]}" if result.shape else ""
            raise InputError(f"{name}{where} is {float(result.ravel()[wrong[0]])}; expected {bound.expected}")
    return result


def vector(name: str, value: Numbers, *, zero_allowed: bool = True) -> Float[Array, " dim"]:
    """A finite vector of the plane or of space."""
    result = jnp.asarray(value, dtype=float)
    if result.shape not in ((2,), (3,)):
        raise InputError(f"{name} has shape {result.shape}; expected 2 or 3 components")
    if not isinstance(result, Tracer) and not np.isfinite(result).all():
        raise InputError(f"{name} is {np.asarray(result)}; expected finite components")
    if not isinstance(result, Tracer) and not zero_allowed and not np.any(result):
        raise InputError(f"{name} is zero; expected a direction")
    return result


def require_dimension(name: str, components: int, dimension: int) -> None:
    """Raises `InputError` where a vector belongs to another space than the scene."""
    if components != dimension:
        raise InputError(f"{name} has {components} components in a scene of dimension {dimension}")


def vertex_list(name: str, vertices: Indices) -> Int[np.ndarray, "m 1"]:
    """Distinct vertices as elements of one corner."""
    indices = _indices(name, vertices, 1)
    if len(np.unique(indices)) < len(indices):
        raise InputError(f"{name} names a vertex twice; expected each vertex once")
    return indices[:, None]


def vertex_pairs(name: str, pairs: Indices) -> Int[np.ndarray, "m 2"]:
    """Pairs of distinct vertices."""
    indices = _indices(name, pairs, 2)
    loops = np.flatnonzero(indices[:, 0] == indices[:, 1])
    if loops.size:
        raise InputError(f"{name}: pair {loops[0]} joins vertex {indices[loops[0], 0]} to itself")
    return indices


def _indices(name: str, values: Indices, axes: int) -> np.ndarray:
    indices = np.asarray(values)
    shape = "[m]" if axes == 1 else "[m, 2]"
    if indices.ndim != axes or (axes == 2 and indices.shape[1] != 2) or indices.size == 0:
        raise InputError(f"{name} has shape {indices.shape}; expected {shape} with m >= 1; leave the term out if none")
    if not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"{name} has type {indices.dtype}; expected integer indices of vertices")
    if indices.min() < 0:
        raise InputError(f"{name} contains the index {indices.min()}; expected indices from 0 on")
    return indices
