"""Lagrangians that are linear in their parameters: trigonometric polynomials of the joint angles, and planar chains.

    L = ½ qdᵀ M(q) qd - V(q),   M_ij(q) = sum_l m_ijl b_l(q),   V(q) = sum_l v_l b_l(q)

The basis b is the product over joints of {1, cos q, .., cos nq, sin q, .., sin nq} for a revolute joint and of
{1, x, .., xⁿ} for a prismatic one, n the joint's degree. With M symmetric, the force

    tau = M qdd + dM/dt qd - ½ d(qdᵀ M qd)/dq + dV/dq + friction * qd

is linear in all parameters, so linear least squares identifies them (`learning.linear`), as Atkeson, An and Hollerbach
(1986, "Estimation of inertial parameters of manipulator loads and links") did for rigid bodies.

Rigid links on revolute joints need degree 1 in every angle for V; M needs degree 1 if the chain is planar and 2
otherwise. The form does not ensure a positive definite M; a singular M gives non-finite accelerations.

A planar chain on a fixed base, or on one or more slides, needs fewer parameters (`make_planar_chain`). With the links'
absolute angles phi, measured from hanging straight down,

    T = ½ sum_ij (A_ij cos(phi_i - phi_j) + B_ij sin(phi_i - phi_j)) phid_i phid_j + ½ sum_i a_i w_i²
    V = -sum_i (g_i cos phi_i + h_i sin phi_i)
    D = sum_i ½ b_i w_i² + c_i v log cosh(w_i / v),   w_i = phid_i - phid_{i-1}, the joint's rate

A is symmetric and B skew. B and h vanish if every centre of mass lies on the line between its joints and the angles are
zero at rest; A_11 includes the armature a_1 of the first motor. All parameters enter linearly
(`learning.linear.fit_linear`), and motions identify all of them ("base parameters"): for a double pendulum, g_2 / A_12
is the acceleration of gravity divided by the length of the first link. Friction acts in the joints for both kinds of
coordinates.

Slides come before all hinges and have phi = 0; in T, the rate of their displacement x takes the place of phid. A_ij and
B_ij of a slide and a link are the components of a mass times a length along the slide. For a slide, V contains
g_i x²/2 - h_i x: a spring, and the weight along the slide.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.explicit import ExplicitSystem, closed_form
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.models.model import Model
from dln_jax.types import InputError, JointKind, Matrix, Needs, Scalar, Vector, require_positive

MOST_COEFFICIENTS = 20_000
"""Largest number of coefficients of the mass matrix. This number grows exponentially with the joints, and the cost of a
fit grows with its square."""
SPRING_DEGREE = 2
"""Lower bound on the degree of the potential in a prismatic displacement, so that it includes a linear spring."""


class TrigonometricParameters(NamedTuple):
    """Coefficients of the basis functions; `None` for absent terms."""

    mass: Array
    """m: lower triangle of M, row by row, times the basis, [d (d + 1) / 2, B]; kg m², kg m or kg."""
    potential: Array | None
    """v [B_V - 1], in J, without the constant, which has no effect."""
    friction: Array | None
    """Viscous friction [d], in N m s or N s/m."""


def make_trigonometric(
    needs: Needs,
    *,
    degree: int | tuple[int, ...] = 1,
    potential_degree: int | tuple[int, ...] | None = None,
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns the (init, energies) pair of a trigonometric Lagrangian.

    `init` ignores its key: M = 1, V = 0, no friction. The number of parameters grows like (2 degree + 1)^d d²/2.

    Args:
        degree: degree of the basis, >= 0: one for all joints, or one per joint. In a prismatic displacement the
            potential has at least degree 2 (a linear spring).
        potential_degree: degree of the potential, if it differs from that of the mass matrix. On a fixed base, V
            depends on the first joint and M does not.

    Raises:
        InputError: a degree is not an integer >= 0, the number of degrees is wrong, or the basis is too large to fit.
    """
    d = needs.degrees_of_freedom
    degrees = _per_joint("degree", degree, d)
    of_potential = degrees if potential_degree is None else _per_joint("potential_degree", potential_degree, d)
    spring_degrees = tuple(
        max(n, SPRING_DEGREE) if joint == "prismatic" else n
        for joint, n in zip(needs.joints, of_potential, strict=True)
    )
    mass_basis = functools.partial(basis, needs.joints, degrees)
    potential_basis = functools.partial(basis, needs.joints, spring_degrees)
    rows, columns = np.tril_indices(d)
    # (i, j) and (j, i) of M read the same row of coefficients.
    entry = np.zeros((d, d), int)
    entry[rows, columns] = entry[columns, rows] = np.arange(len(rows))
    entries, functions = len(rows), _size(needs.joints, degrees)
    if entries * functions > MOST_COEFFICIENTS:
        raise InputError(
            f"the trigonometric mass matrix of {d} joints has {entries} x {functions:,} coefficients, more than "
            f"{MOST_COEFFICIENTS:,}; give some joints a smaller degree, or train a structured network"
        )

    def init(key: Array) -> TrigonometricParameters:
        identity = np.zeros((entries, functions))
        identity[rows == columns, 0] = 1.0
        potential = jnp.zeros(_size(needs.joints, spring_degrees) - 1, dtype)
        return TrigonometricParameters(
            mass=jnp.asarray(identity, dtype),
            potential=potential if needs.gravity else None,
            friction=jnp.zeros(d, dtype) if needs.friction else None,
        )

    def energies(parameters: TrigonometricParameters) -> ExplicitSystem:
        coefficients, potential, friction = parameters.mass[entry], parameters.potential, parameters.friction

        def coriolis(q: Vector, qd: Vector) -> Vector:
            _, slopes = mass_basis(q)
            kinetic = 0.5 * jnp.einsum("i,ijl,j->l", qd, coefficients, qd)
            return (coefficients @ (qd @ slopes)) @ qd - slopes @ kinetic

        return closed_form(
            mass_matrix=lambda q: coefficients @ mass_basis(q)[0],
            coriolis=coriolis,
            potential=None if potential is None else lambda q: potential_basis(q)[0][1:] @ potential,
            gravity=None if potential is None else lambda q: potential_basis(q)[1][:, 1:] @ potential,
            dissipation=None if friction is None else lambda q, qd: 0.5 * jnp.sum(friction * qd**2),
            friction=None if friction is None else lambda q, qd: friction * qd,
        )

    return Model(init, energies)


def _per_joint(name: str, degree: int | tuple[int, ...], d: int) -> tuple[int, ...]:
    degrees = (degree,) * d if isinstance(degree, int) else tuple(degree)
    if len(degrees) != d or not all(isinstance(n, int) and n >= 0 for n in degrees):
        raise InputError(f"{name} is {degree}; expected a whole number >= 0, or one for each of the {d} joints")
    return degrees


def basis(
    joints: tuple[JointKind, ...], degrees: tuple[int, ...], q: Vector
) -> tuple[Float[Array, " B"], Float[Array, "d B"]]:
    """Returns the basis functions b, the first of which is 1, and their derivatives db/dq."""
    values, slopes = zip(*map(_joint_basis, joints, degrees, q), strict=True)
    along = [_products([*values[:joint], slope, *values[joint + 1 :]]) for joint, slope in enumerate(slopes)]
    return _products(values), jnp.stack(along)


def _joint_basis(joint: JointKind, degree: int, x: Scalar) -> tuple[Array, Array]:
    """Returns the functions of one joint, and their derivatives."""
    one, zero = jnp.ones(1, x.dtype), jnp.zeros(1, x.dtype)
    orders = np.arange(1, degree + 1)
    if joint == "revolute":
        cosines, sines = jnp.cos(orders * x), jnp.sin(orders * x)
        return jnp.concatenate([one, cosines, sines]), jnp.concatenate([zero, -orders * sines, orders * cosines])
    values = jnp.concatenate([one, *(jnp.reshape(x**order, 1) for order in range(1, degree + 1))])
    return values, jnp.concatenate([zero, orders * values[:-1]])


def _products(factors: Sequence[Array]) -> Float[Array, " B"]:
    return functools.reduce(lambda products, factor: jnp.outer(products, factor).ravel(), factors)


def _size(joints: tuple[JointKind, ...], degrees: tuple[int, ...]) -> int:
    """Returns the number of basis functions, B."""
    return math.prod(2 * n + 1 if joint == "revolute" else n + 1 for joint, n in zip(joints, degrees, strict=True))


class PlanarChainParameters(NamedTuple):
    """Parameters of d links; `None` for terms that are left out."""

    moments: Any
    """A: its lower triangle, row by row [d (d + 1) / 2], kg m², kg m or kg."""
    skew: Any
    """B: below its diagonal, row by row [d (d - 1) / 2], kg m², kg m or kg."""
    armature: Any
    """a of the hinges after the first, kg m²."""
    weight: Any
    """g [d], N m, or N/m of a slide."""
    sideways: Any
    """h [d], N m or N."""
    viscous: Any
    """b [d], N m s or N s/m."""
    coulomb: Any
    """c [d], N m or N."""


def make_planar_chain(
    needs: Needs,
    *,
    coordinates: str = "relative",
    directions: tuple[int, ...] | None = None,
    symmetric: bool = True,
    armature: bool = False,
    velocity_scale: float = 0.05,
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns the (init, energies) pair of a planar chain; `init` ignores its key: M_ii = 1, all else is zero.

    Args:
        needs: prismatic joints come first; friction adds viscous and dry friction in all joints.
        coordinates: "relative" or "absolute": q_i is the angle of link i from the previous link, or from the vertical.
        directions: 1 or -1 for every joint: -1 if its axis is opposite to the first joint's (default: all 1).
        symmetric: leave out B and h.
        armature: the hinges after the first have armature (the inertia of motors or gears).
        velocity_scale: velocity scale of dry friction, rad/s, as in `FrictionShape`; it is not fitted.

    Raises:
        InputError: a slide comes after a hinge, the coordinates are unknown, a direction is neither 1 nor -1, or a
            scale is not positive.
    """
    require_positive(velocity_scale=velocity_scale)
    d = needs.degrees_of_freedom
    hinge = np.array([joint == "revolute" for joint in needs.joints])
    if (np.diff(hinge.astype(int)) < 0).any():
        raise InputError(f"the joints are {needs.joints}; a planar chain has slides before hinges: use another model")
    if coordinates not in ("relative", "absolute"):
        raise InputError(f"coordinates are {coordinates!r}; expected 'relative' or 'absolute'")
    signs = np.ones(d) if directions is None else np.asarray(directions)
    if signs.shape != (d,) or not (np.abs(signs) == 1).all():
        raise InputError(f"directions are {directions}; expected 1 or -1 for each of the {d} joints")
    # phi and displacements = absolute q, and rates of the joints w = relative qd.
    sums = np.where(hinge[:, None] & hinge, np.tri(d), np.eye(d))
    absolute: Any = (sums if coordinates == "relative" else np.eye(d)) * signs
    relative: Any = np.linalg.inv(sums) @ absolute
    turning: Any = hinge[:, None] * absolute
    geared = np.flatnonzero(hinge)[1:]
    triangle, below = np.tril_indices(d), np.tril_indices(d, -1)

    def init(key: Array) -> PlanarChainParameters:
        def zeros(count: int, wanted: bool) -> Array | None:
            return jnp.zeros(count, dtype) if wanted else None

        return PlanarChainParameters(
            moments=jnp.asarray(triangle[0] == triangle[1], dtype),
            skew=zeros(len(below[0]), not symmetric),
            armature=zeros(len(geared), armature),
            weight=zeros(d, needs.gravity),
            sideways=zeros(d, needs.gravity and not symmetric),
            viscous=zeros(d, needs.friction),
            coulomb=zeros(d, needs.friction),
        )

    def energies(parameters: PlanarChainParameters) -> ExplicitSystem:
        moments, skew, motors, weight, sideways, viscous, coulomb = parameters
        zero = jnp.zeros((d, d), moments.dtype)
        lower = zero.at[triangle].set(moments)
        A = lower + jnp.tril(lower, -1).T
        B = None if skew is None else zero.at[below].set(skew) - zero.at[below].set(skew).T
        fixed = 0.0 if motors is None else relative.T @ jnp.diag(jnp.zeros(d).at[geared].set(motors)) @ relative

        def mass_matrix(q: Vector) -> Matrix:
            between = _between(turning @ q)
            own = A * jnp.cos(between) + (0.0 if B is None else B * jnp.sin(between))
            return absolute.T @ own @ absolute + fixed

        def coriolis(q: Vector, qd: Vector) -> Vector:
            between = _between(turning @ q)
            slopes = A * jnp.sin(between) - (0.0 if B is None else B * jnp.cos(between))
            return absolute.T @ (slopes @ (turning @ qd) ** 2)

        def potential(q: Vector) -> Scalar:
            place = absolute @ q
            height = weight @ jnp.where(hinge, jnp.cos(place), -(place**2) / 2)
            return -height if sideways is None else -height - sideways @ jnp.where(hinge, jnp.sin(place), place)

        dissipation = joint_dissipation(viscous, coulomb, velocity_scale=velocity_scale, joint_map=relative)
        held = (None, None) if weight is None else (potential, jax.grad(potential))
        return closed_form(mass_matrix, coriolis, *held, dissipation)

    return Model(init, energies)


def _between(phi: Vector) -> Matrix:
    return phi[:, None] - phi[None, :]
