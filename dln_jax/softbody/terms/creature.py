"""Terms of the published soft creatures: a preset for comparison with their simulator (2-D; J. Rojas, algovivo).

There a step minimises ½ sum m |x - x_n - h v_n|² + h² V(x); here the same divided by h², so that V is unscaled:

    triangle   ½ mu (I1 - 2) - mu s(J) + ½ lambda s(J)²,   s(J) = -1.5 + 2 J - 0.5 J²
    muscle     ½ k_m ((l - a l0)/(a l0))²,   l = sqrt(d² + 1e-6)
    gravity    m g y
    ground     k y² for y < 0, plus friction k_f ((x - x_n)/h)² (0.01 - y_n) for y_n < 0.01

s is the second-order expansion of ln J, and the weight of a triangle is 1 for any area, so mu and lambda are in J.
The friction is viscous and lagged. k_f is in kg/m, because its part of V is an energy although it is friction: with
vx = (x - x_n)/h the force is -2 k_f (0.01 - y_n) vx / h, which depends on the time step, and h² V does not contain h.
A static solve (h infinite) has no friction.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import determinant
from dln_jax.softbody.terms.elasticity import deformation_gradient, rest_geometry
from dln_jax.softbody.terms.gravity import gravity as weight
from dln_jax.softbody.terms.springs import muscles as driven_springs
from dln_jax.softbody.terms.strain_energies import squared_norm
from dln_jax.softbody.terms.term import NOT_NEGATIVE, Context, Corners, Indices, Numbers, Term, material
from dln_jax.types import InputError, Scalar

MASS = 6.0714288
"""Mass of a vertex, in kg."""
TIME_STEP = 0.033
"""In s."""
FRICTION_HEIGHT = 0.01
"""Height below which the ground exerts friction, in m."""


class CreatureMaterial(NamedTuple):
    """Parameters of the triangles, for all [] or per triangle [m]."""

    mu: Float[Array, "..."]
    """In J."""
    lam: Float[Array, "..."]
    """In J."""


class CreatureGround(NamedTuple):
    """Parameters of the ground, for all vertices [] or per vertex [n]."""

    stiffness: Float[Array, "..."]
    """k in J/m²: half of the stiffness in N/m."""
    friction: Float[Array, "..."]
    """k_f in kg/m."""


def creature_terms(
    mesh: Mesh,
    muscles: Indices,
    *,
    mu: Numbers = 500.0,
    lam: Numbers = 50.0,
    muscle_stiffness: Numbers = 90.0,
    ground_stiffness: Numbers = 14000.0,
    ground_friction: Numbers = 300.0,
    gravity: float = 9.8,
) -> tuple[Term, ...]:
    """Terms "elastic", "muscles", "gravity" and "ground" of a creature above y = 0; muscles are pairs [k, 2].

    The control of a step is the actuation of the muscles, 0.25 to 1 in the published creatures.
    """
    if mesh.dimension != 2:
        raise InputError(f"creature_terms got a mesh of dimension {mesh.dimension}; the preset exists in 2-D only")
    return (
        _triangles(mesh, mu, lam),
        driven_springs(muscles, stiffness=muscle_stiffness, softening=1e-3),
        weight(mesh, (0.0, -gravity)),
        _ground(len(mesh.vertices), ground_stiffness, ground_friction),
    )


def _triangles(mesh: Mesh, mu: Numbers, lam: Numbers) -> Term:
    count = len(mesh.elements)
    parameters = CreatureMaterial(
        material("mu", mu, count, "element"), material("lam", lam, count, "element", NOT_NEGATIVE)
    )

    def prepare(parameters: CreatureMaterial, context: Context) -> tuple[Array, ...]:
        gradients, _ = jax.vmap(rest_geometry)(context.rest[mesh.elements])
        return gradients, *(jnp.broadcast_to(value, count) for value in parameters)

    def energy(x: Corners, triangle: tuple[Array, ...]) -> Scalar:
        """½ mu (I1 - 2) - mu s(J) + ½ lambda s(J)², in J."""
        gradients, mu, lam = triangle
        F = deformation_gradient(x, gradients)
        change = determinant(F) - 1.0
        strain = change - 0.5 * change**2
        return 0.5 * mu * (squared_norm(F) - 2.0) - mu * strain + 0.5 * lam * strain**2

    return Term("elastic", mesh.elements, energy, parameters, prepare)


def _ground(count: int, stiffness: Numbers, friction: Numbers) -> Term:
    rough = material("ground_friction", friction, count, "vertex", NOT_NEGATIVE)
    parameters = CreatureGround(material("ground_stiffness", stiffness, count, "vertex"), rough)

    def prepare(parameters: CreatureGround, context: Context) -> tuple[Array, ...]:
        x, y = context.x.T
        drag = parameters.friction * jnp.maximum(FRICTION_HEIGHT - y, 0.0) / context.dt**2
        return jnp.broadcast_to(parameters.stiffness, count), drag, x

    def energy(x: Corners, vertex: tuple[Array, ...]) -> Scalar:
        stiffness, drag, start = vertex
        along, height = x[0][0] - start, x[0][1]
        return stiffness * jnp.where(height < 0, height**2, 0.0) + drag * along**2

    return Term("ground", np.arange(count)[:, None], energy, parameters, prepare)
