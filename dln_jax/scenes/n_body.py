"""Point masses that attract each other by Newton's law.

    V = -G sum over pairs of m_i m_j / sqrt(r_ij² + s²)

q holds the positions body by body, [n * dimension]. The softening length s is zero by default: V is -inf where bodies
meet.
"""

import jax.numpy as jnp
import numpy as np

from dln_jax.scenes.scene import Scene, no_coriolis
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector, require_positive


def n_body(
    n: int,
    *,
    dimension: int = 2,
    masses: float | tuple[float, ...] = 1.0,
    G: float = 1.0,
    softening: float = 0.0,
) -> Scene:
    """n bodies on a line, in a plane or in space.

    Args:
        n: number of bodies.
        dimension: coordinates per body.
        masses: one for all, or one per body, kg.
        G: gravitational constant, m³/(kg s²); zero for no attraction.
        softening: length s, m; if positive, the force deviates from Newton's law.

    Raises:
        InputError: fewer than two bodies, masses that are not positive or not one per body, or a negative softening.
    """
    each = masses if isinstance(masses, tuple) else (masses,) * n
    require_positive(dimension=dimension, **{f"mass {index}": mass for index, mass in enumerate(each)})
    if n < 2:
        raise InputError(f"n is {n}; expected at least 2 bodies")
    if len(each) != n:
        raise InputError(f"masses has {len(each)} entries; expected one number, or one for each of {n} bodies")
    if not softening >= 0:
        raise InputError(f"softening is {softening}; expected a length in m, zero for none")
    first, second = np.triu_indices(n, 1)
    # Rows subtract one body's position from another's.
    difference = np.eye(n)[first] - np.eye(n)[second]
    strength = G * np.array(each)[first] * np.array(each)[second]

    def pairs(q: Vector):
        """Difference matrix [pairs, n], separations [pairs, dimension], distances and strengths [pairs]."""
        matrix = jnp.asarray(difference, q.dtype)
        separation = jnp.matmul(matrix, q.reshape(n, dimension), precision="highest")
        distance = jnp.sqrt(jnp.sum(separation**2, axis=1) + softening**2)
        return matrix, separation, distance, jnp.asarray(strength, q.dtype)

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.diag(jnp.repeat(jnp.asarray(each, q.dtype), dimension))

    def potential(q: Vector) -> Scalar:
        _, _, distance, strength = pairs(q)
        return -jnp.sum(strength / distance)

    def gravity(q: Vector) -> Vector:
        matrix, separation, distance, strength = pairs(q)
        pull = (strength / distance**3)[:, None] * separation
        return jnp.matmul(matrix.T, pull, precision="highest").ravel()

    needs = Needs(joints=("prismatic",) * (n * dimension), gravity=G != 0)
    attraction = (potential, gravity) if G else (None, None)
    return Scene(
        f"{n}-body", needs, mass_matrix, no_coriolis, *attraction, tip=(lambda q: q[-2:]) if dimension == 2 else None
    )
