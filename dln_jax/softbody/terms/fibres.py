"""Contractile fibres in the material, with one direction per element.

    W = a s |F d| + ½ k (|F d| - 1)²

per volume, with the unit direction d, the stretch |F d| along it, the strength s in Pa (force per area of the rest
shape at full activation), the activation a, and the passive stiffness k in Pa of the fibres, if any.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from dln_jax.softbody.mesh.mesh import Mesh, indices_of
from dln_jax.softbody.terms.elasticity import quadratic_geometry, rest_geometry, shape_gradients
from dln_jax.softbody.terms.springs import length_of
from dln_jax.softbody.terms.strain_energies import DeformationGradient
from dln_jax.softbody.terms.term import NOT_NEGATIVE, Context, Corners, Numbers, Term, material, value_or_control
from dln_jax.solvers.elements.energies import combinations
from dln_jax.types import InputError, Scalar


class Fibres(NamedTuple):
    """Parameters of fibres, one for all elements [] or one per element [m]."""

    direction: Float[Array, "*m dim"]
    """Direction in the rest shape, of any length; one, or one per element."""
    strength: Float[Array, "..."]
    """s in Pa."""
    activation: Float[Array, " groups"] | None
    """Activation a of every group, from 0 to 1; `None` if the control sets it."""
    stiffness: Float[Array, "..."] | None
    """k in Pa, or `None`."""


def fibres(
    mesh: Mesh,
    direction: Numbers,
    *,
    strength: Numbers,
    activation: Numbers | None = None,
    stiffness: Numbers | None = None,
    elements: ArrayLike | None = None,
    groups: ArrayLike | None = None,
    name: str = "fibres",
) -> Term:
    """Fibres that contract with the activation of their group; parameters are `Fibres`.

    Args:
        mesh: linear or quadratic.
        direction: one [dim], or one per element [m, dim], of any length but zero.
        strength: s in Pa, one or per element.
        activation: a, one or one per group; by default a is the control of the step, one number per group.
        stiffness: k in Pa, one or per element; by default the fibres have no passive stiffness.
        elements: the m elements with fibres, such as `mesh.sets["muscle"].elements`; by default all.
        groups: group of every such element [m], counted from 0; by default all are in group 0.

    Raises:
        InputError: a number is out of range, or shapes do not fit.
    """
    chosen = np.arange(len(mesh.elements))
    if elements is not None:
        chosen = indices_of(f"'{name}'", elements, len(chosen), "element")
    if not len(chosen):
        raise InputError(f"'{name}' names no element; expected at least one")
    count = len(chosen)
    group = np.zeros(count, dtype=int) if groups is None else np.asarray(groups)
    if group.shape != (count,) or group.dtype.kind not in "iu" or group.min() < 0:
        raise InputError(
            f"groups are {group.dtype} of shape {list(group.shape)}; expected [{count}] integers from 0 on"
        )
    number = int(group.max()) + 1
    ways = jnp.asarray(direction, dtype=float)
    if ways.shape not in ((mesh.dimension,), (count, mesh.dimension)):
        one = f"[{mesh.dimension}], or [{count}, {mesh.dimension}]: per element"
        raise InputError(f"direction has shape {list(ways.shape)}; expected {one}")
    if not isinstance(ways, Tracer):
        lengths = np.atleast_1d(np.linalg.norm(np.asarray(ways), axis=-1))
        if (wrong := ~(np.isfinite(lengths) & (lengths > 0))).any():
            raise InputError(f"the direction of fibres {np.argmax(wrong)} is zero; expected a direction")
    parameters = Fibres(
        ways,
        material("strength", strength, count, "element", NOT_NEGATIVE),
        None if activation is None else material("activation", activation, number, "group", NOT_NEGATIVE),
        None if stiffness is None else material("stiffness", stiffness, count, "element"),
    )
    nodes = mesh.nodes[chosen]

    def prepare(parameters: Fibres, context: Context) -> tuple[Any, ...]:
        meaning = "the activation of every group of fibres, from 0 to 1"
        activation = value_or_control(parameters.activation, name, context, (number,), meaning)
        geometry = jax.vmap(rest_geometry if mesh.midsides is None else quadratic_geometry)(context.rest[nodes])
        direction = jnp.broadcast_to(parameters.direction, (count, mesh.dimension))
        unit = direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
        stress = jnp.broadcast_to(activation, number)[group] * parameters.strength
        passive = parameters.stiffness
        return *geometry, unit, stress, None if passive is None else jnp.broadcast_to(passive, count)

    def density(F: DeformationGradient, element: tuple[Any, ...]) -> Scalar:
        unit, stress, passive = element
        along = [sum(entry * unit[j] for j, entry in enumerate(row)) for row in F]
        stretch = length_of(jnp.asarray(sum(part**2 for part in along)), 0.0)
        return stress * stretch if passive is None else stress * stretch + 0.5 * passive * (stretch - 1) ** 2

    def energy(F: DeformationGradient, element: tuple[Any, ...]) -> Scalar:
        _, volume, *rest = element
        return volume * density(F, tuple(rest))

    def quadratic_energy(x: Corners, element: tuple[Any, ...]) -> Scalar:
        gradients, weights, *rest = element
        at_points = jax.vmap(lambda slopes: density(combinations(jnp.asarray(x), slopes), tuple(rest)))(gradients)
        return jnp.sum(weights * at_points)

    control = (number,) if activation is None else None
    if mesh.midsides is None:
        return Term(name, nodes, energy, parameters, prepare, control=control, weights=shape_gradients, mesh=mesh)
    return Term(name, nodes, quadratic_energy, parameters, prepare, unrolled=False, control=control, mesh=mesh)
