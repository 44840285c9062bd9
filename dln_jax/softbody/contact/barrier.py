"""The barrier that keeps bodies apart (Li et al. 2020, Incremental Potential Contact, section 4; Li et al. 2023).

    E = kappa A m(c) b(D) / h³,    b(D) = -(D - h²)² ln(D / h²) for 0 < D < h², else 0

with the squared distance D of the pair, the distance h within which it acts, the area A that the pair stands for, and
the stiffness kappa in Pa. b is twice continuously differentiable at D = h² and grows without bound as D vanishes, so
that bodies never touch. Nearly parallel edges are mollified, because the closest points of two edges jump there:

    m(c) = (2 - c/epsilon) c/epsilon for c < epsilon, else 1,    c = |u x v|²,    epsilon = 1e-3 |U|² |V|²

for edges u, v, which are U, V in the rest shape.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.contact.distances import Stencil, separation, squared_distance

MOLLIFIED = 1e-3
"""Squared sine of the angle between edges below which their contact is mollified (Li et al. 2020, section 5)."""


class Pair(NamedTuple):
    """Data of the contact of one pair; [pairs, ...] for all."""

    stencil: Stencil
    strength: Float[Array, "*pairs"]
    """kappa A / h³ in N/m³; zero for a place in the list that is not used."""
    near: Float[Array, "*pairs"]
    """h² in m²."""
    parallel: Float[Array, "*pairs"]
    """epsilon in m⁴ of two edges; zero for other pairs, which are not mollified."""


def barrier(D: Float[Array, ""], near: Float[Array, ""]) -> Float[Array, ""]:
    """b(D) in m⁴ for D > 0; infinite at D = 0."""
    inside = near > D
    safe = jnp.where(inside, D, near)
    return -((safe - near) ** 2) * jnp.log(safe / near)


def barrier_slope(D: Float[Array, ""], near: Float[Array, ""]) -> Float[Array, ""]:
    """db/dD in m², which is negative for D < h²."""
    safe = jnp.where(near > D, D, near)
    return (near - safe) * (2 * jnp.log(safe / near) - near / safe + 1)


def pair_energy(x: Float[Array, "k dim"], pair: Pair) -> Float[Array, ""]:
    """E in J of one pair."""
    used = pair.strength > 0
    D = jnp.where(used, squared_distance(x, pair.stencil), pair.near)
    return pair.strength * mollifier(x, pair.parallel) * barrier(D, pair.near)


def mollifier(x: Float[Array, "k dim"], parallel: Float[Array, ""]) -> Float[Array, ""]:
    """m(c) of two edges with vertices x = (a, b, c, d); 1 for other pairs."""
    if x.shape != (4, 3):
        return jnp.ones((), x.dtype)
    u, v = x[1] - x[0], x[3] - x[2]
    ratio = ((u @ u) * (v @ v) - (u @ v) ** 2) / jnp.where(parallel > 0, parallel, 1.0)
    return jnp.where((parallel > 0) & (ratio < 1), (2 - ratio) * ratio, 1.0)


def normal_force(x: Float[Array, "k dim"], pair: Pair) -> tuple[Float[Array, ""], Array, Array]:
    """Returns the force in N that pushes the primitives apart, its unit direction, and the weights of the vertices."""
    delta, weights = separation(x, pair.stencil)
    D = delta @ delta
    used = (pair.strength > 0) & (pair.near > D)
    distance = jnp.sqrt(jnp.where(used, D, 1.0))
    slope = jnp.where(used, barrier_slope(jnp.where(used, D, pair.near), pair.near), 0.0)
    force = -2 * distance * pair.strength * mollifier(x, pair.parallel) * slope
    return force, jnp.where(used, delta / distance, 0.0), weights
