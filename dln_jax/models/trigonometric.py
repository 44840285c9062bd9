"""Lagrangian that is linear in its parameters: trigonometric polynomials of the joint angles.

    L = ½ qdᵀ M(q) qd - V(q),   M_ij(q) = sum_l m_ijl b_l(q),   V(q) = sum_l v_l b_l(q)

The basis b is the product over joints of {1, cos q, .., cos nq, sin q, .., sin nq} for a revolute joint and of
{1, x, .., xⁿ} for a prismatic one, n the joint's degree. With M symmetric, the force

    tau = M qdd + dM/dt qd - ½ d(qdᵀ M qd)/dq + dV/dq + friction * qd

is linear in all parameters, so a linear least-squares problem identifies them (`learning.linear`), as Atkeson, An and
Hollerbach (1986, "Estimation of inertial parameters of manipulator loads and links") did for rigid bodies.

The basis contains rigid links on revolute joints: V has degree 1 in every angle, and M degree 1 if the chain is planar,
otherwise 2. M is definite only where the data make it so; a singular M gives non-finite accelerations.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float, Int

from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.models.model import Model
from dln_jax.types import InputError, JointKind, Needs, Scalar, Vector

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
    spring_degrees = potential_degrees(needs.joints, of_potential)
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

    return Model(init, lambda parameters: _closed_form(parameters, entry, mass_basis, potential_basis))


def _per_joint(name: str, degree: int | tuple[int, ...], d: int) -> tuple[int, ...]:
    degrees = (degree,) * d if isinstance(degree, int) else tuple(degree)
    if len(degrees) != d or not all(isinstance(n, int) and n >= 0 for n in degrees):
        raise InputError(f"{name} is {degree}; expected a whole number >= 0, or one for each of the {d} joints")
    return degrees


def potential_degrees(joints: tuple[JointKind, ...], degrees: tuple[int, ...]) -> tuple[int, ...]:
    """Returns the degrees of the potential's basis, which includes a linear spring in every prismatic displacement."""
    return tuple(max(n, SPRING_DEGREE) if joint == "prismatic" else n for joint, n in zip(joints, degrees, strict=True))


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


def _closed_form(
    parameters: TrigonometricParameters, entry: Int[np.ndarray, "d d"], mass_basis, potential_basis
) -> ClosedForm:
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
