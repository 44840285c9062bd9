"""Worst-case disturbances of bounded strength, in closed form (Lutter et al. 2021, arXiv:2105.12189).

    dx/dt = f(x + xi_o, u + xi_u, p + xi_p) + xi_x

Every disturbance increases the cost to go as fast as its bound permits, to first order in V_xᵀ f:

    xi_x along V_x,   xi_u along Bᵀ V_x,   xi_o along (df/dx)ᵀ V_x,   all of prescribed length,
    xi_p = +- a share of every parameter, by the sign of (df/dp)ᵀ V_x

A value function trained against them gives robust control.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.types import InputError

Disturbance = Callable[[Array, Array, Array], Array]
"""(x, V_x, u) -> the change of dx/dt [n] due to the worst disturbance."""


class Bounds(NamedTuple):
    """Bounds of the disturbances; zero for none."""

    state: float = 0.0
    """|xi_x|, in the units of dx/dt."""
    action: float = 0.0
    """|xi_u|, in the units of u."""
    observation: float = 0.0
    """|xi_o|, in the units of x."""
    parameters: float = 0.0
    """|xi_p| / |p|."""


def worst_disturbance(
    plant: Callable[[Array, Array, Array], Array],
    parameters: Any,
    bounds: Bounds,
    *,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
) -> Disturbance:
    """Returns the worst case of all disturbances at once.

    Args:
        plant: (x [n], u [m], p [k]) -> dx/dt [n], f.
        parameters: p.
        bounds: bounds of the disturbances.
        lower: bound of p + xi_p [k], for example zero for masses; by default none.
        upper: bound of p + xi_p [k]; by default none.

    Raises:
        InputError: a bound is negative.
    """
    for name, bound in bounds._asdict().items():
        if not bound >= 0:
            raise InputError(f"the bound of {name} is {bound}; expected 0 or more")
    p = jnp.asarray(parameters, float)

    def change(x: Array, slope: Array, u: Array) -> Array:
        rate, pull_back = jax.vjp(plant, x, u, p.astype(x.dtype))
        to_x, to_u, to_p = pull_back(slope)
        worst_p = jnp.clip(p + bounds.parameters * jnp.abs(p) * jnp.sign(to_p), jnp.asarray(lower), jnp.asarray(upper))
        moved = plant(x + bounds.observation * unit(to_x), u + bounds.action * unit(to_u), worst_p.astype(x.dtype))
        return moved - rate + bounds.state * unit(slope)

    return change


def unit(z: Array) -> Array:
    """Returns z / |z|, or zero if z is zero, with finite derivatives."""
    square = jnp.sum(z**2)
    some = square > 0
    return jnp.where(some, z / jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
