"""Rayleigh damping as energies: forces alpha M v and beta K v.

A step of length dt from x_n minimises the dissipation

    mass:       alpha m |x - x_n|² / (2 dt),                                    force  -alpha m v
    stiffness:  beta volume (mu |dE|² + lambda/2 tr(dE)²) / dt,   dE = E(x) - E(x_n),   E = (FᵀF - I)/2

with the velocity v = (x - x_n)/dt. The second is a Kelvin-Voigt material whose viscosities are beta times the Lamé
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
from dln_jax.softbody.terms.elasticity import POISSON_BOUND, lame_parameters, rest_geometry, shape_gradients
from dln_jax.softbody.terms.strain_energies import DeformationGradient, green_strain, linear_energy
from dln_jax.softbody.terms.term import NOT_NEGATIVE, Context, Corners, Numbers, Term, material
from dln_jax.solvers.elements.energies import combinations
from dln_jax.types import Scalar


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


def mass_damping(mesh: Mesh, *, rate: Numbers, name: str = "mass_damping") -> Term:
    """Damps all velocities of a mesh's vertices, including rigid motions, at the rate alpha in 1/s."""
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
