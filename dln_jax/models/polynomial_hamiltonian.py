"""Hamiltonian that is linear in its parameters: polynomials of momenta and displacements, harmonics of angles.

    H(q, p) = sum_k c_k phi_k(q, p)

The phi_k are all products, up to a total degree, of powers of p_j, of powers of the displacements of prismatic joints,
and of cos(n q_j) and sin(n q_j), of degree n, for revolute joints. The constant is left out, because no motion shows
it. Hamilton's equations are linear in c, so linear least squares identifies it from rates of states
(`learning.matching.match_linear`). The number of terms grows with the degree to the power of the number of coordinates.
"""

import itertools
import math

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.models.model import Model
from dln_jax.types import InputError, Needs, Scalar, Vector

MOST_TERMS = 5_000
"""Largest number of terms of the energy; the fit's cost grows with its square."""


def make_polynomial_hamiltonian(needs: Needs, *, degree: int = 2, dtype: DTypeLike = jnp.float32) -> Model:
    """Returns the (init, energies) pair; the parameters are the vector c, initially zero.

    Args:
        needs: needs of the scene. Friction is refused, because it would not be linear in c.
        degree: the largest total degree of a term.

    Raises:
        InputError: the scene has friction, the degree is below 2, or there are more than `MOST_TERMS` terms.
    """
    if needs.friction or needs.joint_friction:
        raise InputError(
            "the polynomial Hamiltonian conserves energy; take a dissipative model for needs with friction"
        )
    if degree < 2:
        raise InputError(f"degree is {degree}; expected at least 2, since kinetic energy is quadratic in p")
    d = needs.degrees_of_freedom
    # Degrees of the functions of one variable, in the order of their table: 1, then x^n, or cos nx and sin nx.
    powers = list(range(degree + 1))
    harmonics = [(place + 1) // 2 for place in range(2 * degree + 1)]
    choices = [harmonics if joint == "revolute" else powers for joint in needs.joints] + [powers] * d
    most = math.prod(map(len, choices))
    if most > MOST_TERMS * 100:
        raise InputError(f"{d} coordinates to degree {degree} make too many terms; lower the degree")
    terms = np.array(
        [
            [place for place, _ in term]
            for term in itertools.product(*map(enumerate, choices))
            if 0 < sum(order for _, order in term) <= degree
        ]
    )
    if len(terms) > MOST_TERMS:
        raise InputError(f"degree {degree} makes {len(terms)} terms; the limit is {MOST_TERMS}: lower the degree")

    def table(revolute: bool, x: Scalar) -> Float[Array, " functions"]:
        if not revolute:
            return jnp.stack([jnp.ones_like(x), *(x**n for n in range(1, degree + 1))])
        waves = [wave(n * x) for n in range(1, degree + 1) for wave in (jnp.cos, jnp.sin)]
        return jnp.stack([jnp.ones_like(x), *waves])

    def values(q: Vector, p: Vector) -> Float[Array, " terms"]:
        product = jnp.ones(len(terms), p.dtype)
        for j in range(d):
            product *= table(needs.joints[j] == "revolute", q[j])[terms[:, j]]
            product *= table(False, p[j])[terms[:, d + j]]
        return product

    def energies(parameters: Array) -> HamiltonianSystem:
        return HamiltonianSystem(lambda q, p: jnp.dot(parameters, values(q, p)))

    return Model(init=lambda key: jnp.zeros(len(terms), dtype), energies=energies)
