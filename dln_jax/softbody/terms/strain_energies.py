"""Energy densities of isotropic elastic materials, in J per m² or m³ of the rest shape, as functions of F = dx/dX.

With I1 = |F|² and J = det F, all densities have W = 0 and no stress at rest and, for small strains e = sym(F - I), the
energy mu |e|² + lambda/2 tr(e)² of linear elasticity, in 2-D (plane strain) and in 3-D. F is a sequence of rows: all
operations are on scalars and fuse under `vmap`.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from dln_jax.softbody.mesh.simplices import cofactors, determinant
from dln_jax.types import Scalar

DeformationGradient = Float[Array, "dim dim"] | Sequence[Sequence[Array]]
"""Rows of F."""
StrainEnergy = Callable[[DeformationGradient, Scalar, Scalar], Scalar]
"""(F, mu, lambda) -> W in J/m^dim; the Lamé parameters are in Pa."""

_LAGUERRE_STEPS = 20
"""Largest number of iterations: enough for double roots, with linear convergence; otherwise 1 to 4 suffice."""


def neo_hookean(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """W = mu/2 (I1 - dim) - mu ln J + lambda/2 (ln J)² (Bonet and Wood 2008, eq. 6.28).

    An inverted or collapsed element (J <= 0) has infinite energy, which every line search refuses, and zero
    derivatives, which leave the sums over elements unchanged.
    """
    J = determinant(F)
    valid = J > 0
    log_J = jnp.log(jnp.where(valid, J, 1.0))
    density = 0.5 * mu * (squared_norm(F) - len(F)) - mu * log_J + 0.5 * lam * log_J**2
    return jnp.where(valid, density, jnp.inf)


def stable_neo_hookean(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """W = mu/2 (I1 - dim) - mu (J - 1) + (lambda + mu)/2 (J - 1)² (Smith, de Goes and Kim 2018).

    The density is a polynomial: finite and smooth for every F, even inverted or collapsed. The paper's lambda equals
    lambda + mu of linear elasticity, because -mu (J - 1) alone contributes -mu/2 tr(e)² to second order. The paper's
    term -mu/2 ln(I1 + 1) is left out, so that the point F = 0 is stationary; at rest nothing changes.
    """
    change = determinant(F) - 1.0
    return 0.5 * mu * (squared_norm(F) - len(F)) - mu * change + 0.5 * (lam + mu) * change**2


def st_venant_kirchhoff(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """W = mu |E|² + lambda/2 tr(E)² with the Green strain E = (FᵀF - I)/2.

    Smooth everywhere, but it softens under compression: uniaxial stress vanishes as the element collapses.
    """
    return linear_energy(green_strain(F), mu, lam)


def green_strain(F: DeformationGradient) -> list[list[Any]]:
    """Returns the rows of the lower triangle of E = (FᵀF - I)/2."""
    axes = range(len(F))
    return [
        [0.5 * (sum(F[k][i] * F[k][j] for k in axes) - (1.0 if i == j else 0.0)) for j in axes if j <= i] for i in axes
    ]


def linear_energy(strain: Sequence[Sequence[Array]], mu: Scalar, lam: Scalar) -> Scalar:
    """Returns mu |E|² + lambda/2 tr(E)² of a symmetric E, from the rows of its lower triangle."""
    axes = range(len(strain))
    trace = sum(strain[i][i] for i in axes)
    squared = sum((1.0 if i == j else 2.0) * strain[i][j] ** 2 for i in axes for j in range(i + 1))
    return mu * squared + 0.5 * lam * trace**2


def corotated(F: DeformationGradient, mu: Scalar, lam: Scalar) -> Scalar:
    """W = mu |F - R|² + lambda/2 tr(RᵀF - I)² with the rotation R closest to F (McAdams et al. 2011).

    In invariants, W = mu (I1 - 2 s + dim) + lambda/2 (s - dim)², where s = tr(RᵀF) is the sum of the singular values,
    and the smallest one has the sign of J. Where the two smallest cancel, R is not unique and W has a crease: in 2-D at
    mirror images, in 3-D at elements collapsed to a line or mirrored in the plane of equal stretches. See
    `rotation_trace`.
    """
    s, dimension = rotation_trace(F), len(F)
    return mu * (squared_norm(F) - 2.0 * s + dimension) + 0.5 * lam * (s - dimension) ** 2


def squared_norm(F: DeformationGradient) -> Scalar:
    """Returns I1 = |F|²."""
    return jnp.asarray(sum(entry * entry for row in F for entry in row))


def rotation_trace(F: DeformationGradient) -> Scalar:
    """Returns s = max over rotations R of tr(RᵀF), with correct first and second derivatives, without an SVD.

    In 2-D s² = (F11 + F22)² + (F21 - F12)². In 3-D s is the largest root of (s² - I1)² - 8 J s - 4 |cof F|² (the
    characteristic polynomial of Davenport's 4x4 matrix, with real roots only). On the crease this root is double or
    triple, so s is accurate to 1e-8 or 1e-6 (in float64). The derivative there is F s/|F|², correct for a change of
    size; it is zero at F = 0 and on the crease in 2-D, where s = 0.
    """
    if len(F) == 2:
        squared = (F[0][0] + F[1][1]) ** 2 + (F[1][0] - F[0][1]) ** 2
        smooth = squared > 0
        return jnp.where(smooth, jnp.sqrt(jnp.where(smooth, squared, 1.0)), 0.0)
    return _largest_root(squared_norm(F), determinant(F), squared_norm(cofactors(F)))


def _largest_root(I1: Scalar, J: Scalar, minors: Scalar) -> Scalar:
    def polynomial(s: Scalar, I1: Scalar, J: Scalar, minors: Scalar) -> Scalar:
        return (s * s - I1) ** 2 - 8.0 * J * s - 4.0 * minors

    def slope(s: Scalar, I1: Scalar, J: Scalar) -> Scalar:
        return 4.0 * s * (s * s - I1) - 8.0 * J

    constants = jax.lax.stop_gradient((I1, J, minors))

    # Laguerre's method from an upper bound decreases to the largest root, cubically if the root is simple.
    def improve(carry):
        s, _, count = carry
        value, rate = polynomial(s, *constants), slope(s, *constants[:2])
        curvature = 12.0 * s * s - 4.0 * constants[0]
        divisor = rate + jnp.sqrt(jnp.maximum(9.0 * rate * rate - 12.0 * value * curvature, 0.0))
        change = jnp.where(divisor > 0, 4.0 * value / jnp.where(divisor > 0, divisor, 1.0), 0.0)
        return s - change, change, count + 1

    def unfinished(carry):
        s, change, count = carry
        return (jnp.abs(change) > 8.0 * precision * s) & (count < _LAGUERRE_STEPS)

    start = jnp.sqrt(3.0 * constants[0])
    precision = jnp.finfo(start.dtype).eps
    s, _, _ = jax.lax.while_loop(unfinished, improve, (start, start, jnp.asarray(0)))

    # From the constant root, one Newton step makes derivatives correct to order 1, two steps to order 3.
    simple = slope(s, *constants[:2]) > 32.0 * jnp.sqrt(precision) * s**3
    root = s
    for _ in range(2):
        root -= polynomial(root, I1, J, minors) / jnp.where(simple, slope(root, I1, J), 1.0)
    extended = constants[0] > 0
    norm = jnp.sqrt(jnp.where(extended, I1, 1.0))
    return jnp.where(simple, root, jnp.where(extended, s * norm / jax.lax.stop_gradient(norm), 0.0))
