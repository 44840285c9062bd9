"""Terms of the published soft creatures, a preset for comparison with their simulator (J. Rojas, algovivo).

Their step minimises ½ sum m |x - x_n - h v_n|² + h² V(x). Here the sum is divided by h², so V is unscaled:

    element    ½ mu (I1 - dim) - mu s(J) + ½ lambda s(J)²,   s(J) = -1.5 + 2 J - 0.5 J²
    muscle     ½ k_m ((l - a l0)/(a l0))²,   l = sqrt(d² + 1e-6)
    gravity    m g y
    ground     k y² for y < 0, plus friction k_f ((x - x_n)/h)² (0.01 - y_n) for y_n < 0.01

s is the second-order expansion of ln J, and the weight of an element is 1 for any size, so mu and lambda are in J.
Friction is viscous and lagged. k_f is in kg/m, because the friction enters V as an energy. With vx = (x - x_n)/h the
force is -2 k_f (0.01 - y_n) vx / h, which depends on the time step; h² V does not contain h. A static solve (h
infinite) has no friction.

The published creatures are planar, on flat ground. In space y is the last coordinate, x are the others, and elements
are tetrahedra. Above rough ground, y is the height above sum_i A_i sin(k_i·x + phi_i).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.simplices import determinant
from dln_jax.softbody.terms.elasticity import rest_geometry, shape_gradients
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.springs import muscles as driven_springs
from dln_jax.softbody.terms.strain_energies import DeformationGradient, squared_norm
from dln_jax.softbody.terms.term import Context, Corners, Indices, Term
from dln_jax.types import InputError, Scalar

MASS = 6.0714288
"""Mass of a vertex, in kg."""
TIME_STEP = 0.033
"""In s."""
FRICTION_HEIGHT = 0.01
"""The ground exerts friction up to this height, m."""


class CreatureMaterial(NamedTuple):
    """Parameters of the triangles, one for all [] or one per triangle [m]."""

    mu: Float[Array, "..."]
    """In J."""
    lam: Float[Array, "..."]
    """In J."""


class Bumps(NamedTuple):
    """Waves of the ground: the height at x is the sum of `amplitude` sin(`wave_vector`·x + `phase`)."""

    amplitude: Float[Array, " w"]
    """In m."""
    wave_vector: Float[Array, "w horizontal"]
    """In rad/m, along the horizontal axes."""
    phase: Float[Array, " w"]
    """In rad."""


class CreatureGround(NamedTuple):
    """Parameters of the ground, one for all vertices [] or one per vertex [n]."""

    stiffness: Float[Array, "..."]
    """k in J/m²: half of the stiffness in N/m."""
    friction: Float[Array, "..."]
    """k_f in kg/m."""
    bumps: Bumps | None = None
    """Shape of rough ground; `None` for flat ground."""


def ground_height(bumps: Bumps, horizontal: Sequence[Array] | Array) -> Array:
    """Returns the height of rough ground in m at a point with these horizontal coordinates."""
    phase = bumps.phase + sum(bumps.wave_vector[:, i] * coordinate for i, coordinate in enumerate(horizontal))
    return jnp.sum(bumps.amplitude * jnp.sin(phase))


def creature_terms(
    mesh: Mesh,
    muscles: Indices,
    *,
    bumps: Bumps | None = None,
) -> tuple[Term, ...]:
    """Returns the terms "elastic", "muscles", "gravity" and "ground" of a creature above y = 0.

    Muscles are pairs of vertices [k, 2]. The control of a step is their actuation, 0.25 to 1 in the published
    creatures. With `bumps` the ground is rough.
    """
    if bumps is not None and np.shape(bumps.wave_vector)[-1] != mesh.dimension - 1:
        got, expected = np.shape(bumps.wave_vector)[-1], mesh.dimension - 1
        raise InputError(f"the bumps' wave vectors have {got} components; expected {expected}, one per horizontal axis")
    return (
        _elements(mesh),
        driven_springs(muscles, stiffness=90.0, softening=1e-3),
        gravity(mesh, (*(0.0,) * (mesh.dimension - 1), -9.8)),
        _ground(len(mesh.vertices), bumps),
    )


def _elements(mesh: Mesh) -> Term:
    count, parameters = len(mesh.elements), CreatureMaterial(jnp.asarray(500.0), jnp.asarray(50.0))

    def prepare(parameters: CreatureMaterial, context: Context) -> tuple[Array, ...]:
        gradients, _ = jax.vmap(rest_geometry)(context.rest[mesh.elements])
        return gradients, *(jnp.broadcast_to(value, count) for value in parameters)

    def energy(F: DeformationGradient, element: tuple[Array, ...]) -> Scalar:
        _, mu, lam = element
        change = determinant(F) - 1.0
        strain = change - 0.5 * change**2
        return 0.5 * mu * (squared_norm(F) - len(F)) - mu * strain + 0.5 * lam * strain**2

    return Term("elastic", mesh.elements, energy, parameters, prepare, weights=shape_gradients, mesh=mesh)


def _ground(count: int, bumps: Bumps | None) -> Term:
    parameters = CreatureGround(jnp.asarray(14000.0), jnp.asarray(300.0), bumps)

    def height(x: Sequence[Array] | Array, bumps: Bumps | None) -> Array:
        return x[-1] if bumps is None else x[-1] - ground_height(bumps, x[:-1])

    def prepare(parameters: CreatureGround, context: Context) -> tuple[Any, ...]:
        bumps = parameters.bumps
        above = jax.vmap(lambda x: height(x, bumps))(context.x)
        drag = parameters.friction * jnp.maximum(FRICTION_HEIGHT - above, 0.0) / context.dt**2
        everywhere = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), bumps)
        return jnp.broadcast_to(parameters.stiffness, count), drag, context.x[:, :-1], everywhere

    def energy(x: Corners, vertex: tuple[Any, ...]) -> Scalar:
        stiffness, drag, start, bumps = vertex
        above = height(x[0], bumps)
        along = sum((coordinate - start[i]) ** 2 for i, coordinate in enumerate(x[0][:-1]))
        return stiffness * jnp.where(above < 0, above**2, 0.0) + drag * along

    return Term("ground", np.arange(count)[:, None], energy, parameters, prepare)
