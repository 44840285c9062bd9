"""What a soft body's energy is made of: terms, each a sum over elements of one scalar function.

    V(x) = sum over terms, sum over elements e:  energy(x[indices[e]], data[e])

An element is whatever the energy couples: the corners of a triangle, the two ends of a spring, a single vertex above
ground. `prepare` turns a term's parameters into the data of its elements once per time step, so that everything an
element needs (rest shape, material, actuation, lagged contact forces) is differentiable.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from dln_jax.solvers.elements.energies import Corners


class Context(NamedTuple):
    """What the preparation of a term may look at: a time step's data, shared by all terms."""

    rest: Float[Array, "n dim"]
    """Rest shape in m."""
    masses: Float[Array, " n"]
    """In kg."""
    x: Float[Array, "n dim"]
    """Positions at the start of the step, in m."""
    dt: Float[Array, ""]
    """Length of the step in s; infinite for a static solve."""
    control: Float[Array, " controls"] | None
    """Actuation, for scenes that have one."""


class Term(NamedTuple):
    """A sum of energies of elements of one kind."""

    name: str
    """Under which its parameters are found in `Params.terms`; unique in a scene."""
    indices: Int[np.ndarray, "m k"]
    """Vertices of each element."""
    energy: Callable[[Corners, Any], Float[Array, ""]]
    """(positions x[k][i] of one element's vertices, its data) -> J. The positions are `Corners`, scalars: arithmetic of
    scalars fuses over all elements, where slices and stacks of arrays do not."""
    parameters: Any
    """Default parameters: a NamedTuple of arrays, SI units."""
    prepare: Callable[[Any, Context], Any]
    """(parameters, context) -> data of the elements: a pytree of arrays with leading axis m."""
