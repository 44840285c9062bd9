"""Masses in potential wells, and point masses that attract each other."""

import jax.numpy as jnp
import numpy as np

from dln_jax.scenes.scene import Scene, no_coriolis, textbook
from dln_jax.types import InputError, Matrix, Scalar, Vector, require_positive


def mass_spring(*, mass: float = 1.0, stiffness: float = 1.0, friction: float = 0.0) -> Scene:
    """A mass on a spring: V = ½ k q², with q = 0 at rest; in kg, N/m (zero for no spring) and N s/m."""
    require_positive(mass=mass)

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.full((1, 1), mass, q.dtype)

    def potential(q: Vector) -> Scalar:
        return 0.5 * stiffness * jnp.sum(q**2)

    def gravity(q: Vector) -> Vector:
        return stiffness * q

    def tip(q: Vector) -> Vector:
        return jnp.array([q[0], 0.0])

    equations = mass_matrix, no_coriolis, potential if stiffness else None, gravity, tip
    return textbook("mass-spring", ("prismatic",), *equations, friction=friction)


def henon_heiles(*, coupling: float = 1.0, friction: float = 0.0) -> Scene:
    """The Hénon-Heiles system, with regular or chaotic orbits depending on the energy.

        H = ½ (p₁² + p₂²) + ½ (x² + y²) + λ (x² y - y³/3)

    The well opens at the energy 1/(6 λ²): motions above it may escape to infinity in finite time. Source: Hénon and
    Heiles (1964), "The applicability of the third integral of motion".

    The coupling λ is in 1/m; mass 1 kg, linear stiffness 1 N/m; friction in N s/m.
    """

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.eye(2, dtype=q.dtype)

    def potential(q: Vector) -> Scalar:
        x, y = q
        return 0.5 * (x**2 + y**2) + coupling * (x**2 * y - y**3 / 3)

    def gravity(q: Vector) -> Vector:
        x, y = q
        return jnp.array([x + 2 * coupling * x * y, y + coupling * (x**2 - y**2)])

    equations = mass_matrix, no_coriolis, potential, gravity, lambda q: q
    return textbook("henon-heiles", ("prismatic", "prismatic"), *equations, friction=friction)


def n_body(
    n: int,
    *,
    dimension: int = 2,
    masses: float | tuple[float, ...] = 1.0,
    G: float = 1.0,
    softening: float = 0.0,
) -> Scene:
    """Point masses on a line, in a plane or in space that attract each other by Newton's law.

        V = -G sum over pairs of m_i m_j / sqrt(r_ij² + s²)

    q holds the positions body by body, [n * dimension]. Without softening, V is -inf where bodies meet.

    Args:
        dimension: coordinates per body.
        masses: one mass for all bodies, or one per body, kg.
        G: gravitational constant, m³/(kg s²); zero for no attraction.
        softening: length s, m; if positive, the force deviates from Newton's law.

    Raises:
        InputError: there are fewer than two bodies, masses are not positive or not one per body, or softening < 0.
    """
    per_body = masses if isinstance(masses, tuple) else (masses,) * n
    require_positive(dimension=dimension, **{f"mass {index}": mass for index, mass in enumerate(per_body)})
    if n < 2:
        raise InputError(f"n is {n}; expected at least 2 bodies")
    if len(per_body) != n:
        raise InputError(f"masses has {len(per_body)} entries; expected one number, or one for each of {n} bodies")
    if not softening >= 0:
        raise InputError(f"softening is {softening}; expected a length of at least 0 m")
    first, second = np.triu_indices(n, 1)
    # Each row subtracts the positions of two bodies.
    difference = np.eye(n)[first] - np.eye(n)[second]
    strength = G * np.array(per_body)[first] * np.array(per_body)[second]

    def pairs(q: Vector):
        """Returns the difference matrix [pairs, n], separations [pairs, dimension], distances and strengths [pairs]."""
        matrix = jnp.asarray(difference, q.dtype)
        separation = jnp.matmul(matrix, q.reshape(n, dimension), precision="highest")
        distance = jnp.sqrt(jnp.sum(separation**2, axis=1) + softening**2)
        return matrix, separation, distance, jnp.asarray(strength, q.dtype)

    def mass_matrix(q: Vector) -> Matrix:
        return jnp.diag(jnp.repeat(jnp.asarray(per_body, q.dtype), dimension))

    def potential(q: Vector) -> Scalar:
        _, _, distance, strength = pairs(q)
        return -jnp.sum(strength / distance)

    def gravity(q: Vector) -> Vector:
        matrix, separation, distance, strength = pairs(q)
        pull = (strength / distance**3)[:, None] * separation
        return jnp.matmul(matrix.T, pull, precision="highest").ravel()

    tip = (lambda q: q[-2:]) if dimension == 2 else None
    equations = mass_matrix, no_coriolis, potential if G else None, gravity, tip
    return textbook(f"{n}-body", ("prismatic",) * (n * dimension), *equations)
