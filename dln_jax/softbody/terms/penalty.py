"""The penalty phi of contact with its derivative and integral, and the damping for a coefficient of restitution."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float
from scipy.optimize import brentq

from dln_jax.types import InputError, require_positive


def penalty(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns phi(d) in m²."""
    if width == 0.0:
        return jnp.where(distance < 0, 0.5 * distance**2, 0.0)
    ramp = jnp.where(distance < 0, -(distance**3) / (6.0 * width), 0.0)
    return jnp.where(distance < -width, 0.5 * distance * (distance + width) + width**2 / 6.0, ramp)


def penalty_force(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns -phi'(d) in m, the normal force divided by k."""
    if width == 0.0:
        return jnp.where(distance < 0, -distance, 0.0)
    ramp = jnp.where(distance < 0, distance**2 / (2.0 * width), 0.0)
    return jnp.where(distance < -width, -distance - 0.5 * width, ramp)


def penalty_integral(distance: Float[Array, "*m"], width: float) -> Float[Array, "*m"]:
    """Returns Phi(d) in m³, the integral of phi from 0."""
    if width == 0.0:
        return jnp.where(distance < 0, distance**3 / 6.0, 0.0)
    ramp = jnp.where(distance < 0, -(distance**4) / (24.0 * width), 0.0)
    deep = distance**3 / 6.0 + width * distance**2 / 4.0 + width**2 * distance / 6.0 + width**3 / 24.0
    return jnp.where(distance < -width, deep, ramp)


def damping_of_restitution(restitution: float, speed: float) -> float:
    """Returns the damping c in s/m that makes a point mass rebound at `restitution` times its speed, in m/s.

    c suits this speed only: slower impacts rebound faster, at 1 - 2/3 c u for small c u. A body also turns some of the
    energy into its own vibrations, which is not a loss of the contact.

    Raises:
        InputError: the speed is not positive, or the coefficient is not between 0.05 and 1.
    """
    require_positive(speed=speed)
    if not 0.05 <= restitution <= 1.0:
        raise InputError(f"restitution is {restitution}; expected a coefficient from 0.05 to 1")
    if restitution == 1.0:
        return 0.0

    def excess(z: float) -> float:
        return math.log1p(z) - math.log1p(-restitution * z) - z * (1 + restitution)

    return float(brentq(excess, 0.1 * (1 - restitution), (1 - 1e-15) / restitution)) / speed  # pyright: ignore
