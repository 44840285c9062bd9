"""Energy terms of a soft body: a term is a sum over elements of one scalar function.

    V(x) = sum over terms, sum over elements e:  energy(x[indices[e]], data[e])

An element is a set of coupled vertices: the corners of a triangle, the two ends of a spring, a single vertex above
ground. `prepare` turns a term's parameters into the data of its elements once per time step, so all data of an element
(rest shape, material, actuation, lagged contact forces) are differentiable.

Factories of terms check their values when the scene is built. Traced values (a scene built under `jit` or `grad`) are
not checked, nor are values that later replace the defaults.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.solvers.elements.energies import Corners
from dln_jax.types import InputError

Numbers = ArrayLike | Sequence[float | int]
"""One number for all elements, or one per element."""
Indices = ArrayLike | Sequence[int | np.integer] | Sequence[Sequence[int | np.integer]]


Pose = tuple[Float[Array, " dim"], Float[Array, "k dim"]]
"""Origin in m and orthonormal axes of a rigid surface; friction and damping take its motion from them. It is the
property `pose` of a term's parameters. A single axis turns without spin, and without axes nothing turns."""


class Context(NamedTuple):
    """Data of a time step for the preparation of elements."""

    rest: Float[Array, "n dim"]
    """Rest shape in m."""
    masses: Float[Array, " n"]
    """In kg."""
    x: Float[Array, "n dim"]
    """Positions at the start of the step, in m."""
    dt: Float[Array, ""]
    """Length of the step in s; infinite for a static solve."""
    control: Any = None
    """Control of the step for this term, if any: an array (for a single actuator the whole control)."""
    lag: Float[Array, "n dim"] | None = None
    """Positions in m for the normal forces and directions of friction; by default at the start of the step."""
    before: Mapping[str, Pose] | None = None
    """Poses of surfaces a time dt before the end of the step, by the names of their terms; others do not move."""


class Term(NamedTuple):
    """A sum of energies of elements of one kind."""

    name: str
    """Key of its parameters in `Params.terms`; unique in a scene."""
    indices: Int[np.ndarray, "m k"]
    """Vertices of the elements."""
    energy: Callable[[Corners, Any], Float[Array, ""]]
    """(positions x[k][i] of one element's vertices, its data) -> J. The positions are scalars (`Corners`): scalar
    arithmetic fuses over all elements, unlike slices and stacks of arrays. With `weights`, the energy takes
    combinations of them."""
    parameters: Any
    """Default parameters: a NamedTuple of arrays, SI units."""
    prepare: Callable[[Any, Context], Any]
    """(parameters, context) -> data of the elements: a pytree of arrays with leading axis m."""
    unrolled: bool = True
    """False if the energy takes an array [k, dim] instead of scalars: compiles faster beyond a dozen unknowns."""
    control: tuple[int, ...] | None = None
    """Shape of the control that `prepare` reads from its context; `None` without control."""
    lagged: bool = False
    """True if `prepare` reads `Context.lag`."""
    mesh: Mesh | None = None
    """Mesh of the term, if any; the scene must have the same mesh."""
    weights: Callable[[Any], Any] | None = None
    """Data of one element -> w[k][j], for an energy of y[i][j] = sum over vertices k of x[k][i] w[k][j] (rows of a
    deformation gradient, an edge) instead of positions. The Hessian then compiles and runs faster."""


class Bound(NamedTuple):
    """Range of accepted values."""

    holds: Callable[[np.ndarray], np.ndarray]
    """Elementwise test; false for NaN."""
    expected: str
    """The range in words."""


POSITIVE = Bound(lambda values: (values > 0) & np.isfinite(values), "a positive number")
NOT_NEGATIVE = Bound(lambda values: (values >= 0) & np.isfinite(values), "zero or a positive number")


def material(
    name: str, value: Numbers, count: int, element: str, bound: Bound = POSITIVE
) -> Float[Array, ""] | Float[Array, " m"]:
    """Validates a value for all elements [] or one per element [m]; `InputError` names the first invalid element."""
    result = jnp.asarray(value, dtype=float)
    if result.shape not in ((), (count,)):
        raise InputError(f"{name} has shape {result.shape}; expected one number, or {count}: one per {element}")
    known = np.ones(0) if isinstance(result, Tracer) else np.atleast_1d(np.asarray(result))
    if (wrong := np.flatnonzero(~bound.holds(known))).size:
        where = f" of {element} {wrong[0]}" if result.shape else ""
        raise InputError(f"{name}{where} is {float(known[wrong[0]])}; expected {bound.expected}")
    return result


def value_or_control(
    value: Any, name: str, context: Context, shape: tuple[int, ...], meaning: str
) -> Float[Array, "..."]:
    """Returns a parameter, or in place of `None` the control of the term (a number as [] or [1]).

    Raises:
        InputError: the control is missing or has another shape; the message states its meaning.
    """
    if value is not None:
        return value
    control = context.control
    if control is None or (jnp.shape(control) != shape and not jnp.size(control) == math.prod(shape) == 1):
        got = "no control" if control is None else f"a control of shape {jnp.shape(control)}"
        raise InputError(f"{name} got {got}; expected shape {shape}: {meaning}")
    return jnp.asarray(control, context.x.dtype).reshape(shape)


def vector(name: str, value: Numbers, *, zero_allowed: bool = True) -> Float[Array, " dim"]:
    """Validates a finite vector in the plane or in space."""
    result = jnp.asarray(value, dtype=float)
    if result.shape not in ((2,), (3,)):
        raise InputError(f"{name} has shape {result.shape}; expected 2 or 3 components")
    if isinstance(result, Tracer):
        return result
    if not np.isfinite(result).all():
        raise InputError(f"{name} is {np.asarray(result)}; expected finite components")
    if not zero_allowed and not np.any(result):
        raise InputError(f"{name} is zero; expected a direction")
    return result


def require_dimension(name: str, components: int, dimension: int) -> None:
    """Raises `InputError` unless a vector has the scene's dimension."""
    if components != dimension:
        raise InputError(f"{name} has {components} components in a scene of dimension {dimension}")


def vertex_rows(name: str, values: Indices, corners: int) -> Int[np.ndarray, "m corners"]:
    """Returns distinct vertices as elements of one corner, or pairs of different vertices as elements of two."""
    indices = np.asarray(values)
    if indices.ndim != corners or indices.shape[1:] != (2,) * (corners - 1) or indices.size == 0:
        shape = "[m]" if corners == 1 else "[m, 2]"
        raise InputError(f"{name} has shape {indices.shape}; expected {shape} with m >= 1; leave the term out if none")
    if not np.issubdtype(indices.dtype, np.integer):
        raise InputError(f"{name} has type {indices.dtype}; expected integer indices of vertices")
    if indices.min() < 0:
        raise InputError(f"{name} contains the index {indices.min()}; expected indices from 0 on")
    rows = indices.reshape(-1, corners)
    if corners == 1 and len(np.unique(rows)) < len(rows):
        raise InputError(f"{name} names a vertex twice; expected each vertex once")
    if corners == 2 and (loops := np.flatnonzero(rows[:, 0] == rows[:, 1])).size:
        raise InputError(f"{name}: pair {loops[0]} joins vertex {rows[loops[0], 0]} to itself")
    return rows
