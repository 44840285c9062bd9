"""Elastic and damped simplices: triangles (plane strain, thickness 1 m) and tetrahedra, linear, quadratic or mixed.

    linear:     F = [x1 - x0, ..., xd - x0] [X1 - X0, ..., Xd - X0]⁻¹,   energy = volume W(F, mu, lambda)
    quadratic:  F_q = sum over nodes of x_k (grad N_k)ᵀ at point q,       energy = sum over q of w_q W(F_q, mu, lambda)
    mixed:      J = sum of w_q det F_q / volume,   energy = sum of w_q W(F_q, mu, 0) + volume lambda/2 (J - 1)²

with the rest shape X and Lamé parameters mu = E / 2(1 + nu) and lambda = E nu / (1 + nu)(1 - 2 nu). The material is any
density of `strain_energies`, or a custom density of the same form.

Linear elements lock: they are too stiff in bending, and nearly rigid as nu approaches 1/2. Quadratic elements represent
bending; their displacements converge with order 3 for smooth solutions. As nu approaches 1/2, they need mixed elements.

Mixed elements are quadratic in displacement with one pressure per element, p = lambda (J - 1), eliminated from sum of
w_q W(F_q, mu, 0) + volume (p (J - 1) - p²/(2 lambda)) (P2/P0, a perturbed Lagrangian; at small strains the selective
reduced integration of Malkus and Hughes 1978). The result is an energy of the positions alone, so a step remains a
minimisation. In the plane the pair satisfies the inf-sup condition (Boffi, Brezzi and Fortin 2013, chapter 8) and does
not lock. In space there is no such proof, because no node lies inside a face to control its flux; clamped cubes of
unordered tetrahedra converge without locking (tests/softbody/test_quadratic_elements.py). A constant pressure limits
displacements to order 2, and it cannot vary through the thickness of a beam. With one element across, the beam is up to
1.6 times too soft in bending. For such beams use quadratic elements, split by `mesh.barycentric_split` if nu is close
to 1/2.

Rayleigh damping, with the forces alpha M v and beta K v, is an energy too. A step of length dt from x_n minimises the
dissipation

    mass:       alpha m |x - x_n|² / (2 dt),                                    force  -alpha m v
    stiffness:  beta volume (mu |dE|² + lambda/2 tr(dE)²) / dt,   dE = E(x) - E(x_n),   E = (FᵀF - I)/2

with the velocity v = (x - x_n)/dt. The second is a Kelvin-Voigt material with viscosities of beta times the Lamé
parameters: rotations do not dissipate, and for small strains its force is -beta K v with the stiffness K of linear
elasticity. A vibration of frequency omega decays as exp(-(alpha + beta omega²) t / 2). A static solve has no damping.
Backward Euler and bdf2 integrate these forces with an error of first order in dt, other integrators of second order.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import cofactors, determinant, jacobians, reference_gradients
from dln_jax.softbody.terms.strain_energies import DeformationGradient, StrainEnergy, green_strain, linear_energy
from dln_jax.softbody.terms.term import NOT_NEGATIVE, Bound, Context, Corners, Numbers, Term, material
from dln_jax.solvers.elements.energies import combinations
from dln_jax.types import InputError, Scalar

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


class MassDamping(NamedTuple):
    """Parameters of mass-proportional damping."""

    rate: Float[Array, "..."]
    """alpha in 1/s, for all vertices [] or per vertex [n]."""


class StiffnessDamping(NamedTuple):
    """Parameters of stiffness-proportional damping, for all elements [] or per element [m]."""

    time: Float[Array, "..."]
    """beta in s."""
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
    mixed: bool = False,
    name: str = "elastic",
) -> Term:
    """Elastic energy of all elements of a mesh, linear or quadratic; parameters are a `Material`.

    Young's modulus in Pa must be positive and Poisson's ratio between -1 and 0.5 (exclusive), one for all elements or
    one per element. In 2-D the strain is plane, so mu and lambda are as in 3-D.

    Mixed elements, for nu near 1/2, need a quadratic mesh. Their volumetric energy is lambda/2 (J - 1)² of the mean J,
    as in the stable neo-Hookean density. For other densities the difference is of third order in J - 1, or of third
    order in strain if lambda multiplies a trace of strains (St. Venant-Kirchhoff, corotated).

    Raises:
        InputError: a parameter is out of range (the message names the element), `mixed` is used with a linear mesh, or
            the mid-side nodes of a quadratic element invert it.
    """
    count = len(mesh.elements)
    if mesh.midsides is None and mixed:
        raise InputError("mixed elements are quadratic; build the term and the scene from quadratic(mesh)")
    if mesh.midsides is not None:
        inverted = (jacobians(mesh.vertices, mesh.nodes) <= 0).any(axis=1)
        if inverted.any():
            raise InputError(
                f"element {np.argmax(inverted)} is inverted at a quadrature point; move its mid-side nodes"
            )
    parameters = Material(
        material("youngs_modulus", youngs_modulus, count, "element"),
        material("poisson_ratio", poisson_ratio, count, "element", POISSON_BOUND),
    )

    def prepare(parameters: Material, context: Context) -> tuple[Array, ...]:
        mu, lam = lame_parameters(*parameters)
        geometry = jax.vmap(rest_geometry if mesh.midsides is None else quadratic_geometry)(context.rest[mesh.nodes])
        return *geometry, jnp.broadcast_to(mu, count), jnp.broadcast_to(lam, count)

    def energy(F: DeformationGradient, element: tuple[Array, ...]) -> Scalar:
        _, volume, mu, lam = element
        return volume * density(F, mu, lam)

    def quadratic_energy(corners: Corners, element: tuple[Array, ...]) -> Scalar:
        x = jnp.asarray(corners)
        gradients, weights, mu, lam = element
        # All points at once: products of small matrices compile much faster than unrolled sums.
        axes = range(x.shape[1])
        F = [[gradients[:, :, j] @ x[:, i] for j in axes] for i in axes]
        of_points = 0.0 * lam if mixed else lam
        stored = jnp.sum(weights * jax.vmap(lambda F: density(F, mu, of_points))(F))
        if not mixed:
            return stored
        return stored + 0.5 * lam * jnp.sum(weights * (determinant(F) - 1.0)) ** 2 / weights.sum()

    if mesh.midsides is None:
        return Term(name, mesh.elements, energy, parameters, prepare, weights=shape_gradients, mesh=mesh)
    return Term(name, mesh.nodes, quadratic_energy, parameters, prepare, unrolled=False, mesh=mesh)


def mass_damping(mesh: Mesh, *, rate: Numbers, name: str = "mass_damping") -> Term:
    """Damps the velocities of all vertices, including rigid motions, at the rate alpha in 1/s."""
    count = len(mesh.vertices)
    parameters = MassDamping(material("rate", rate, count, "vertex", NOT_NEGATIVE))

    def prepare(parameters: MassDamping, context: Context) -> tuple[Array, Array]:
        return parameters.rate * context.masses / context.dt, context.x

    def energy(x: Corners, vertex: tuple[Array, Array]) -> Scalar:
        weight, start = vertex
        return 0.5 * weight * jnp.asarray(sum((coordinate - start[i]) ** 2 for i, coordinate in enumerate(x[0])))

    return Term(name, np.arange(count)[:, None], energy, parameters, prepare, mesh=mesh)


def stiffness_damping(
    mesh: Mesh,
    *,
    time: Numbers,
    youngs_modulus: Numbers,
    poisson_ratio: Numbers,
    name: str = "stiffness_damping",
) -> Term:
    """Damps the strain rates of all elements of a mesh, with the time beta in s and the moduli of the elastic material.

    The moduli belong to this term: replacing those of the elastic term does not change them.
    """
    count = len(mesh.elements)
    parameters = StiffnessDamping(
        material("time", time, count, "element", NOT_NEGATIVE),
        material("youngs_modulus", youngs_modulus, count, "element"),
        material("poisson_ratio", poisson_ratio, count, "element", POISSON_BOUND),
    )

    def prepare(parameters: StiffnessDamping, context: Context) -> tuple[Any, ...]:
        gradients, volumes = jax.vmap(rest_geometry)(context.rest[mesh.elements])
        before = jax.vmap(lambda x, gradients: green_strain(combinations(x, gradients)))
        mu, lam = lame_parameters(parameters.youngs_modulus, parameters.poisson_ratio)
        weights = parameters.time * volumes / context.dt
        return gradients, weights * mu, weights * lam, before(context.x[mesh.elements], gradients)

    def energy(F: DeformationGradient, element: tuple[Any, ...]) -> Scalar:
        _, mu, lam, before = element
        after = green_strain(F)
        change = [[now - then for now, then in zip(*rows, strict=True)] for rows in zip(after, before, strict=True)]
        return linear_energy(change, mu, lam)

    return Term(name, mesh.elements, energy, parameters, prepare, weights=shape_gradients, mesh=mesh)


def lame_parameters(youngs_modulus: Array, poisson_ratio: Array) -> tuple[Array, Array]:
    """Returns (mu, lambda) in Pa from E in Pa and nu."""
    mu = youngs_modulus / (2.0 * (1.0 + poisson_ratio))
    return mu, 2.0 * mu * poisson_ratio / (1.0 - 2.0 * poisson_ratio)


def rest_geometry(corners: Float[Array, "corners dim"]) -> tuple[Float[Array, "corners dim"], Scalar]:
    """Returns the gradients of a simplex's linear shape functions in 1/m, and its signed volume in m³ (m² in 2-D).

    F = sum over corners of x_k (grad N_k)ᵀ. The explicit formulas are differentiable.
    """
    axes = range(corners.shape[1])
    edges = [[corners[k + 1, i] - corners[0, i] for k in axes] for i in axes]
    size = determinant(edges)
    # The rows of the inverse belong to corners 1 to d; all rows sum to zero.
    inverse = jnp.stack([jnp.stack(row) for row in zip(*cofactors(edges), strict=True)]) / size
    gradients = jnp.concatenate([-jnp.sum(inverse, axis=0, keepdims=True), inverse])
    return gradients, size / (2.0 if len(edges) == 2 else 6.0)


def quadratic_geometry(
    nodes: Float[Array, "nodes dim"],
) -> tuple[Float[Array, "points nodes dim"], Float[Array, " points"]]:
    """Returns the gradients of a quadratic simplex's shape functions at its quadrature points in 1/m, and weights.

    The weights are the points' shares of the volume, in m³, or m² in 2-D.
    """
    by_reference = jnp.asarray(reference_gradients(nodes.shape[1]))
    jacobian = nodes.T @ by_reference
    rows = [[jacobian[:, i, j] for j in range(nodes.shape[1])] for i in range(nodes.shape[1])]
    size = determinant(rows)
    # grad N = J⁻ᵀ dN/dl with J⁻ᵀ = cof J / det J.
    inverse = jnp.stack([jnp.stack(row, axis=-1) for row in cofactors(rows)], axis=-2) / size[:, None, None]
    return by_reference @ inverse.swapaxes(1, 2), size / (len(size) * (2.0 if len(rows) == 2 else 6.0))


def shape_gradients(element: tuple[Any, ...]) -> Float[Array, "corners dim"]:
    """Returns the shape function gradients, the first of an element's data; they combine positions to F."""
    return element[0]
