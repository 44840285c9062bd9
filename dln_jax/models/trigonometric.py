"""Lagrangians that are linear in their parameters: trigonometric polynomials of the joint angles, and planar chains.

    L = ½ qdᵀ M(q) qd - V(q),   M_ij(q) = sum_l m_ijl b_l(q),   V(q) = sum_l v_l b_l(q)

The basis b is the product over joints of {1, cos q, .., cos nq, sin q, .., sin nq} for a revolute joint and of
{1, x, .., xⁿ} for a prismatic one, n the joint's degree. With M symmetric, the force

    tau = M qdd + dM/dt qd - ½ d(qdᵀ M qd)/dq + dV/dq + friction * qd

is linear in all parameters, so a linear least-squares problem identifies them (`learning.linear`), as Atkeson, An and
Hollerbach (1986, "Estimation of inertial parameters of manipulator loads and links") did for rigid bodies.

The basis contains rigid links on revolute joints: V has degree 1 in every angle, and M degree 1 if the chain is planar,
otherwise 2. M is definite only where the data make it so; a singular M gives non-finite accelerations.

A chain of links in one plane, on a fixed base, a slide or several, needs fewer parameters (`make_planar_chain`). With
the links' absolute angles phi, measured from hanging straight down,

    T = ½ sum_ij (A_ij cos(phi_i - phi_j) + B_ij sin(phi_i - phi_j)) phid_i phid_j + ½ sum_i a_i w_i²
    V = -sum_i (g_i cos phi_i + h_i sin phi_i)
    D = sum_i ½ b_i w_i² + c_i v log cosh(w_i / v),   w_i = phid_i - phid_{i-1}, the joint's rate

A is symmetric and B skew. B and h vanish if the centres of mass lie on the lines between joints and the zeros of the
angles are right; the armature a_1 of the first motor is part of A_11. All parameters enter linearly
(`learning.linear.fit_linear`) and are identifiable from motions ("base parameters"): for a double pendulum, g_2 / A_12
is the acceleration of gravity divided by the first link's length. Friction acts in the joints, for any coordinates.

Slides, which come before all hinges, have phi = 0: A_ij and B_ij of a slide and a link are the components of a mass
times a length along the slide. Their phid in T is the rate of the displacement x, and V has g_i x²/2 - h_i x, a spring
and the weight along the slide, in place of their other terms.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.models.model import Model
from dln_jax.types import InputError, JointKind, Matrix, Needs, Scalar, Vector, require_positive

MOST_COEFFICIENTS = 20_000
"""Limit on the coefficients of the mass matrix, which grow exponentially with the joints (the fit with the square)."""
SPRING_DEGREE = 2
"""Lower bound on the degree of the potential in a prismatic displacement, so that it includes a linear spring."""


class TrigonometricParameters(NamedTuple):
    """Coefficients of the basis functions; `None` for a term that the scene lacks."""

    mass: Array
    """m: lower triangle of M, row by row, times the basis, [d (d + 1) / 2, B]; kg m², kg m or kg."""
    potential: Array | None
    """v [B_V - 1], in J, without the constant, which no motion shows."""
    friction: Array | None
    """Viscous friction [d], in N m s or N s/m."""


class Basis(NamedTuple):
    """The basis functions at one q."""

    values: Array
    """b [B]; the first is 1."""
    slopes: Array
    """db/dq [d, B]."""


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
        degree: degree of the basis in every joint, or one for all; >= 0. In a prismatic displacement the potential has
            at least degree 2 (a linear spring).
        potential_degree: degree of the potential if it differs: M of a chain on a fixed base does not depend on its
            first joint, but V does.

    Raises:
        InputError: a degree is not an integer >= 0, the number of degrees is wrong, or the basis is too large to fit.
    """
    d = needs.degrees_of_freedom
    degrees = _per_joint("degree", degree, d)
    of_potential = degrees if potential_degree is None else _per_joint("potential_degree", potential_degree, d)
    mass_basis = functools.partial(basis, needs.joints, degrees)
    spring_degrees = tuple(
        max(n, SPRING_DEGREE) if joint == "prismatic" else n
        for joint, n in zip(needs.joints, of_potential, strict=True)
    )
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

    def energies(parameters: TrigonometricParameters) -> ClosedForm:
        coefficients, potential, friction = parameters.mass[entry], parameters.potential, parameters.friction

        def coriolis(q: Vector, qd: Vector) -> Vector:
            slopes = mass_basis(q).slopes
            kinetic = 0.5 * jnp.einsum("i,ijl,j->l", qd, coefficients, qd)
            return (coefficients @ (qd @ slopes)) @ qd - slopes @ kinetic

        return ClosedForm(
            mass_matrix=lambda q: coefficients @ mass_basis(q).values,
            coriolis=coriolis,
            potential=None if potential is None else lambda q: potential_basis(q).values[1:] @ potential,
            gravity=None if potential is None else lambda q: potential_basis(q).slopes[:, 1:] @ potential,
            dissipation=None if friction is None else lambda q, qd: 0.5 * jnp.sum(friction * qd**2),
            friction=None if friction is None else lambda q, qd: friction * qd,
        )

    return Model(init, energies)


def _per_joint(name: str, degree: int | tuple[int, ...], d: int) -> tuple[int, ...]:
    degrees = (degree,) * d if isinstance(degree, int) else tuple(degree)
    if len(degrees) != d or not all(isinstance(n, int) and n >= 0 for n in degrees):
        raise InputError(f"{name} is {degree}; expected a whole number >= 0, or one for each of the {d} joints")
    return degrees


def basis(joints: tuple[JointKind, ...], degrees: tuple[int, ...], q: Vector) -> Basis:
    """Returns the products over joints of the joints' functions, and their partial derivatives."""
    factors = [_joint_basis(*joint) for joint in zip(joints, degrees, q, strict=True)]
    values = [factor.values for factor in factors]
    slopes = [
        _products([*values[:joint], factor.slopes[0], *values[joint + 1 :]]) for joint, factor in enumerate(factors)
    ]
    return Basis(_products(values), jnp.stack(slopes))


def _joint_basis(joint: JointKind, degree: int, x: Scalar) -> Basis:
    one, zero = jnp.ones(1, x.dtype), jnp.zeros(1, x.dtype)
    if joint == "revolute":
        orders = np.arange(1, degree + 1)
        cosines, sines = jnp.cos(orders * x), jnp.sin(orders * x)
        values = jnp.concatenate([one, cosines, sines])
        slopes = jnp.concatenate([zero, -orders * sines, orders * cosines])
    else:
        values = jnp.concatenate([one, *(jnp.reshape(x**order, 1) for order in range(1, degree + 1))])
        slopes = jnp.concatenate([zero, np.arange(1, degree + 1) * values[:-1]])
    return Basis(values, slopes[None])


def _products(factors: list[Array]) -> Float[Array, " B"]:
    return functools.reduce(lambda products, factor: jnp.outer(products, factor).ravel(), factors)


def _size(joints: tuple[JointKind, ...], degrees: tuple[int, ...]) -> int:
    """Returns B."""
    sizes = (2 * n + 1 if joint == "revolute" else n + 1 for joint, n in zip(joints, degrees, strict=True))
    return int(np.prod([*sizes]))


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
        directions: 1 or -1 for every joint: -1 if its axis points against that of the first (default: all 1).
        symmetric: whether B and h are left out.
        armature: whether the hinges after the first have armature (the inertia of motors or gears).
        velocity_scale: velocity scale of dry friction, rad/s, as in `FrictionShape`; it is not fitted.

    Raises:
        InputError: a slide comes after a hinge, the coordinates are unknown, a direction is neither 1 nor -1, or a
            scale is not positive.
    """
    require_positive(velocity_scale=velocity_scale)
    d = needs.degrees_of_freedom
    hinge = np.array([joint == "revolute" for joint in needs.joints])
    if (np.diff(hinge.astype(int)) < 0).any():
        raise InputError(f"the joints are {needs.joints}; a planar chain has slides before hinges: take another model")
    if coordinates not in ("relative", "absolute"):
        raise InputError(f"coordinates are {coordinates!r}; expected 'relative' or 'absolute'")
    signs = np.ones(d) if directions is None else np.asarray(directions)
    if signs.shape != (d,) or not (np.abs(signs) == 1).all():
        raise InputError(f"directions are {directions}; expected 1 or -1 for each of the {d} joints")
    # phi and displacements = absolute q, and rates of the joints w = relative qd.
    sums = np.where(hinge[:, None] & hinge, np.tril(np.ones((d, d))), np.eye(d))
    absolute: Any = (sums if coordinates == "relative" else np.eye(d)) * signs
    relative: Any = np.linalg.inv(sums) @ absolute
    turning: Any = hinge[:, None] * absolute
    geared = np.flatnonzero(hinge)[1:]
    triangle, below = np.tril_indices(d), np.tril_indices(d, -1)

    def init(key: Array) -> PlanarChainParameters:
        def zeros(count: int, wanted: bool) -> Array | None:
            return jnp.zeros(count, dtype) if wanted else None

        return PlanarChainParameters(
            moments=jnp.asarray((triangle[0] == triangle[1]).astype(float), dtype),
            skew=zeros(len(below[0]), not symmetric),
            armature=zeros(len(geared), armature),
            weight=zeros(d, needs.gravity),
            sideways=zeros(d, needs.gravity and not symmetric),
            viscous=zeros(d, needs.friction),
            coulomb=zeros(d, needs.friction),
        )

    def energies(parameters: PlanarChainParameters) -> ClosedForm:
        moments, skew, motors, weight, sideways, viscous, coulomb = parameters
        like = jnp.zeros((d, d), moments.dtype)
        A = like.at[triangle].set(moments)
        A = A + A.T - jnp.diag(jnp.diagonal(A))
        B = None if skew is None else like.at[below].set(skew) - like.at[below].set(skew).T
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

        dissipation = None
        if viscous is not None:
            dissipation = joint_dissipation(viscous, coulomb, velocity_scale=velocity_scale, joint_map=relative)
        return ClosedForm(
            mass_matrix=mass_matrix,
            coriolis=coriolis,
            potential=None if weight is None else potential,
            gravity=None if weight is None else jax.grad(potential),
            dissipation=dissipation,
            friction=None if dissipation is None else jax.grad(dissipation, argnums=1),
        )

    return Model(init, energies)


def _between(phi: Vector) -> Matrix:
    return phi[:, None] - phi[None, :]
