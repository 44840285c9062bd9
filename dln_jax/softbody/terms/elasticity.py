"""Elastic simplices: constant strain triangles (plane strain, thickness 1 m) and tetrahedra.

    F = [x1 - x0, ..., xd - x0] [X1 - X0, ..., Xd - X0]⁻¹,   energy = volume W(F, mu, lambda)

with the rest shape X and Lamé parameters mu = E / 2(1 + nu) and lambda = E nu / (1 + nu)(1 - 2 nu). The material is any
density of `strain_energies`, or a custom one of the same form.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import cofactors, determinant
from dln_jax.softbody.terms.strain_energies import StrainEnergy
from dln_jax.softbody.terms.term import Bound, Context, Corners, Numbers, Term, material
from dln_jax.types import Scalar

POISSON_BOUND = Bound(
    lambda ratio: (ratio > -1.0) & (ratio < 0.5),
    "more than -1 and less than 0.5 (0.49 or 0.4999 for a nearly incompressible material)",
)


class Material(NamedTuple):
    """An isotropic elastic material, one for all elements [] or one per element [m]."""

    youngs_modulus: Float[Array, "..."]
    """E in Pa."""
    poisson_ratio: Float[Array, "..."]
    """nu, between -1 and 0.5."""


def elastic(
    mesh: Mesh,
    density: StrainEnergy,
    *,
    youngs_modulus: Numbers = 1e5,
    poisson_ratio: Numbers = 0.3,
    name: str = "elastic",
) -> Term:
    """Elastic energy of all elements of a mesh; parameters are a `Material`.

    Young's modulus in Pa must be positive and Poisson's ratio between -1 and 0.5 (excluded), one for all elements or
    one per element; otherwise `InputError` names the element. In 2-D the strain is plane, so that mu and lambda are
    those of the solid.
    """
    count = len(mesh.elements)
    parameters = Material(
        material("youngs_modulus", youngs_modulus, count, "element"),
        material("poisson_ratio", poisson_ratio, count, "element", POISSON_BOUND),
    )

    def prepare(parameters: Material, context: Context) -> tuple[Array, ...]:
        mu, lam = lame_parameters(*parameters)
        geometry = jax.vmap(rest_geometry)(context.rest[mesh.elements])
        return *geometry, jnp.broadcast_to(mu, count), jnp.broadcast_to(lam, count)

    def energy(x: Corners, element: tuple[Array, ...]) -> Scalar:
        gradients, volume, mu, lam = element
        return volume * density(deformation_gradient(x, gradients), mu, lam)

    return Term(name, mesh.elements, energy, parameters, prepare)


def lame_parameters(youngs_modulus: Array, poisson_ratio: Array) -> tuple[Array, Array]:
    """(mu, lambda) in Pa from E in Pa and nu."""
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio)


def rest_geometry(corners: Float[Array, "corners dim"]) -> tuple[Float[Array, "corners dim"], Scalar]:
    """Gradients of a simplex's linear shape functions, 1/m, F = sum over corners of x_k (grad N_k)ᵀ, and signed volume.

    The volume is in m³, or m² in 2-D. The formulas are written out and differentiable.
    """
    axes = range(corners.shape[1])
    edges = [[corners[k + 1, i] - corners[0, i] for k in axes] for i in axes]
    size = determinant(edges)
    # The rows of the inverse belong to corners 1 to d; all rows sum to zero.
    inverse = jnp.stack([jnp.stack(row) for row in zip(*cofactors(edges), strict=True)]) / size
    gradients = jnp.concatenate([-jnp.sum(inverse, axis=0, keepdims=True), inverse])
    return gradients, size / (2.0 if len(edges) == 2 else 6.0)


def deformation_gradient(x: Corners, shape_gradients: Float[Array, "corners dim"]) -> list[list[Array]]:
    """Rows of F = dx/dX."""
    corners, axes = range(len(x)), range(len(x) - 1)
    gradients = [[shape_gradients[k, j] for j in axes] for k in corners]
    return [[jnp.asarray(sum(x[k][i] * gradients[k][j] for k in corners)) for j in axes] for i in axes]
