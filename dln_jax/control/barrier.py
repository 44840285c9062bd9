"""Newton steps of an interior-point method on the conditions of an optimal trajectory.

An inequality c - t + s = 0 has a slack s > 0 with multiplier z. A soft one also has an excess t > 0 with multiplier y,
which costs w_1 t + w_2 t² / 2. The conditions s z = μ and t y = μ eliminate slacks and excesses, which leaves a
quadratic program over the horizon.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from dln_jax.control.conditions import Slopes, Values, along, program, stationarity
from dln_jax.control.riccati import HorizonSolution, least_cost

END_COMPLIANCE = 1e-8
"""Compliance of the equations of the end in the linear systems; it does not change the solution."""


class Inequalities(NamedTuple):
    """Masks [M] and weights of the inequalities."""

    present: Array
    elastic: Array
    """Soft inequalities."""
    strict: Array
    """Limits of controls and durations, which no iterate may leave."""
    linear: Any
    square: Any


class Iterate(NamedTuple):
    """Unknowns and multipliers."""

    x: Array
    u: Array
    prices: Array
    """λ [N, n]."""
    nu: Array
    s: Array
    z: Array
    t: Array
    y: Array


class Residuals(NamedTuple):
    """Largest absolute residuals of the optimality conditions."""

    stationarity: Array
    feasibility: Array
    complementarity: Array

    def largest(self) -> Array:
        """Returns the largest of the three."""
        return jnp.max(jnp.stack(self))


def gaps(of: Inequalities, at: Iterate, values: Values) -> Array:
    """Returns the residuals c - t + s of the inequalities."""
    return jnp.where(of.present, values.c + at.s - at.t, 0.0)


def measure(of: Inequalities, at: Iterate, values: Values, barrier: Array) -> tuple[Array, Array]:
    """Returns the sum of the violations, and the barrier function, infinite if it is not a finite number."""
    violation = jnp.sum(jnp.abs(jnp.concatenate([values.defects.ravel(), values.h, gaps(of, at, values)])))
    price = of.linear * at.t + of.square * at.t**2 / 2 - barrier * jnp.log(at.t)
    phi = values.cost - barrier * jnp.sum(jnp.where(of.present, jnp.log(at.s), 0.0))
    phi = phi + jnp.sum(jnp.where(of.elastic, price, 0.0))
    return violation, jnp.where(jnp.isfinite(phi), phi, jnp.inf)


def slope(of: Inequalities, at: Iterate, slopes: Slopes, step: Iterate, barrier: Array) -> Array:
    """Returns the derivative of the barrier function along a step."""
    fall = along(slopes, step.x, step.u)[0] - barrier * jnp.sum(jnp.where(of.present, step.s / at.s, 0.0))
    return fall + jnp.sum(jnp.where(of.elastic, (of.linear + of.square * at.t - barrier / at.t) * step.t, 0.0))


def residuals(
    of: Inequalities, at: Iterate, values: Values, slopes: Slopes, barrier: Any, free: Any
) -> tuple[Residuals, Residuals]:
    """Returns the residuals at a barrier, plain and divided by 1/100 of the mean multiplier if that is above one."""
    gradient = stationarity(slopes, at.prices, at.z, at.nu, free)
    products = jnp.where(of.present, at.s * at.z - barrier, 0.0)
    gradient = jnp.append(gradient, jnp.where(of.elastic, of.linear + of.square * at.t - at.z - at.y, 0.0))
    products = jnp.append(products, jnp.where(of.elastic, at.t * at.y - barrier, 0.0))
    unmet = jnp.concatenate([values.defects.ravel(), values.h, gaps(of, at, values)])
    plain = Residuals(*(jnp.max(jnp.abs(r), initial=0.0) for r in (gradient, unmet, products)))
    of_rows, number = jnp.sum(at.z) + jnp.sum(at.y), jnp.maximum(jnp.sum(of.present), 1)
    every = jnp.sum(jnp.abs(at.prices)) + jnp.sum(jnp.abs(at.nu)) + of_rows
    scale = jnp.maximum(every / (at.prices.size + at.nu.size + number) / 100, 1.0)
    scale_z = jnp.maximum(of_rows / number / 100, 1.0)
    return plain, Residuals(plain[0] / scale, plain[1], plain[2] / scale_z)


def newton(
    of: Inequalities, at: Iterate, slopes: Slopes, curvatures: tuple[Array, Array], barrier: Array, unmet: Values,
    gap: Array, damping: Array, free: Any,
) -> tuple[HorizonSolution, Iterate]:  # fmt: skip
    """Returns the Newton step, as a solution of the quadratic program and as a change of the iterate."""
    stiff = at.z / at.s
    drive = jnp.where(of.present, barrier / at.s, 0.0) - at.z + stiff * gap
    give = jnp.where(of.elastic, 1 / (of.square + at.y / at.t), 0.0)
    off = jnp.where(of.elastic, of.linear + of.square * at.t - at.z - barrier / at.t, 0.0)
    drive, stiff = (drive + stiff * give * off) / (1 + stiff * give), stiff / (1 + stiff * give)
    horizon = program(slopes, curvatures, at.z + drive, stiff, unmet.defects, damping)
    horizon = horizon._replace(
        end_gradient=horizon.end_gradient + slopes.h.T @ (at.nu + unmet.h / END_COMPLIANCE),
        end_curvature=horizon.end_curvature + slopes.h.T @ slopes.h / END_COMPLIANCE,
    )
    change = least_cost(horizon, free)
    _, of_c, of_h = along(slopes, change.dx, change.du)
    dz = drive + stiff * of_c
    dt = give * (dz - off)
    dy = jnp.where(of.elastic, (barrier - at.y * dt) / at.t - at.y, 0.0)
    prices, nu = change.multipliers - at.prices, (unmet.h + of_h) / END_COMPLIANCE
    return change, Iterate(change.dx, change.du, prices, nu, dt - gap - of_c, dz, dt, dy)


def to_boundary(of: Inequalities, at: Iterate, step: Iterate, share: Array) -> tuple[Array, Array]:
    """Returns the longest step lengths, at most one, that use up at most `share` of s and t, and of z and y."""

    def longest(*pairs: tuple[Array, Array, Array]) -> Array:
        fastest = [jnp.max(jnp.where(mask, -d / v, 0.0), initial=0.0) for v, d, mask in pairs]
        return jnp.minimum(1.0, share / jnp.maximum(jnp.max(jnp.stack(fastest)), 1e-30))

    return (
        longest((at.s, step.s, of.present), (at.t, step.t, of.elastic)),
        longest((at.z, step.z, of.present), (at.y, step.y, of.elastic)),
    )


def inside(of: Inequalities, values: Values, x: Array, u: Array, margin: float) -> Iterate:
    """Returns the first iterate: slacks of at least a margin unless strict, z = 1, y >= 1, other multipliers zero."""
    t = jnp.where(of.elastic, jnp.maximum(values.c, 0.0) + margin, 0.0)
    slack = jnp.where(of.strict & (values.c < 0), -values.c, jnp.maximum(t - values.c, margin))
    s, z = jnp.where(of.present, slack, 1.0), jnp.where(of.present, 1.0, 0.0)
    y = jnp.where(of.elastic, jnp.maximum(of.linear + of.square * t - z, 1.0), 0.0)
    return Iterate(x, u, jnp.zeros_like(values.defects), jnp.zeros_like(values.h), s, z, t, y)


def guarded(of: Inequalities, at: Iterate, barrier: Array, spread: float) -> Iterate:
    """Limits z and y so that s z and t y stay within the factor `spread` of the barrier."""

    def within(z: Array, s: Array, mask: Array) -> Array:
        return jnp.where(mask, jnp.clip(z, barrier / (spread * s), spread * barrier / s), 0.0)

    return at._replace(z=within(at.z, at.s, of.present), y=within(at.y, at.t, of.elastic))
