"""Chain of d uniform rods with a motor in every joint, for studying how cost grows with d."""

import jax.numpy as jnp
import numpy as np

from dln_jax.scenes.scene import Scene, viscous_dissipation
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector


def chain(
    d: int, *, mass: float = 1.0, length: float = 1.0, acceleration: float = 9.81, friction: float = 0.0
) -> Scene:
    """The planar chain with angles relative to the previous link, q = 0 hanging; per link kg and m, m/s², N m s.

    In absolute angles θ = cumsum(q) the equations are short (a_ij cos(θ_i - θ_j) couples rods i and j). The constant
    matrix S of the sum transforms them to joint coordinates: M = Sᵀ M_θ S, and likewise for forces.

    Raises:
        InputError: d < 1.
    """
    if d < 1:
        raise InputError(f"chain: d = {d} links; give at least 1")
    outer_rods = np.arange(d - 1, -1, -1.0)  # number of rods below each rod
    farther = np.minimum(outer_rods[:, None], outer_rods[None, :])
    coupling = mass * length**2 * (farther + 0.5)
    np.fill_diagonal(coupling, mass * length**2 * (outer_rods + 1 / 3))
    weight = mass * acceleration * length * (outer_rods + 0.5)

    def mass_matrix(q: Vector) -> Matrix:
        angles = jnp.cumsum(q)
        return _sum_outwards(_sum_outwards(coupling * jnp.cos(angles[:, None] - angles)).T)

    def coriolis(q: Vector, qd: Vector) -> Vector:
        angles, rates = jnp.cumsum(q), jnp.cumsum(qd)
        return _sum_outwards((coupling * jnp.sin(angles[:, None] - angles)) @ rates**2)

    def potential(q: Vector) -> Scalar:
        return jnp.sum(weight * (1 - jnp.cos(jnp.cumsum(q))))

    def gravity(q: Vector) -> Vector:
        return _sum_outwards(weight * jnp.sin(jnp.cumsum(q)))

    def tip(q: Vector) -> Vector:
        angles = jnp.cumsum(q)
        return length * jnp.array([jnp.sum(jnp.sin(angles)), -jnp.sum(jnp.cos(angles))])

    needs = Needs(joints=("revolute",) * d, friction=friction != 0)
    return Scene(f"chain-{d}", needs, mass_matrix, coriolis, potential, gravity, viscous_dissipation(friction), tip)


def _sum_outwards(forces):
    """Sᵀ times the rows: a joint's torque is the sum over its own rod and all rods beyond it."""
    return jnp.cumsum(forces[::-1], axis=0)[::-1]
