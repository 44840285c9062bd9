"""Motors that turn with several joints, and their inertia: the armature as a matrix.

    motor rates = S qd,   A = Sᵀ (diag(I) + C) S,   M = M_links + A

S [d, d] is a known constant matrix, the identity if every motor turns only with its own joint. If a parallelogram or a
belt drives joint 3 from a motor that does not move with joint 2, its rate is qd_2 + qd_3, so row 3 of S is (0, 1, 1). I
[d] are the inertias of the motors at that rate. C is symmetric with a zero diagonal, and non-zero only at stated pairs
of joints: the constant inertia that couples one joint's acceleration to another joint's motor if gear ratios are
unknown. A motor of joint 3 on link 2 with gear ratio n, parallel to joint 2, has C_23 = I_3 / n.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.types import InputError, Vector, finite_array

Pair = tuple[int, int]
"""Two joints, counted from 0, the lower one first."""
LARGEST_CONDITION = 1e6
"""Largest condition number of S; above it, motor rates hardly determine joint rates."""


def require_motors(rates: Any, coupled: Sequence[Pair], d: int) -> None:
    """Raises `InputError` unless `rates` is an invertible matrix S or `None`, and each pair has two different
    joints."""
    if rates is not None:
        S = finite_array("motors", rates, (d, d))
        if not np.linalg.cond(S) < LARGEST_CONDITION:
            raise InputError(f"motors is {S.tolist()}; expected an invertible matrix S, motor rates = S qd")
    if len(set(coupled)) < len(coupled) or not all(0 <= i < j < d for i, j in coupled):
        stated = ", ".join(f"{i + 1}:{j + 1}" for i, j in coupled)
        raise InputError(f"coupled is {stated}; expected distinct pairs i:j of joints with 1 <= i < j <= {d}")


def armature_matrix(inertias: Any, rates: Any = None, coupling: Mapping[Pair, Any] | None = None) -> Any:
    """Returns A [d, d], or I [d] unchanged if every motor turns only with its own joint; NumPy if all is known."""
    if rates is None and not coupling:
        return inertias
    A = np.eye(len(inertias)) * inertias
    for (i, j), value in (coupling or {}).items():
        place = np.zeros(A.shape)
        place[i, j] = place[j, i] = 1.0
        A = A + value * place
    S = np.eye(len(A)) if rates is None else np.asarray(rates, float)
    return S.T @ A @ S


def motor_regressor(rates: Any, coupled: Sequence[Pair], qdd: Vector) -> Float[Array, "d P"]:
    """Returns the forces of unit I and of unit entries of C, in the order of the motors, then of the pairs."""
    S = jnp.eye(qdd.shape[0], dtype=qdd.dtype) if rates is None else jnp.asarray(rates, qdd.dtype)
    u = S @ qdd
    pairs = [S[i] * u[j] + S[j] * u[i] for i, j in coupled]
    return jnp.stack([*(S.T * u).T, *pairs], axis=1)


def motors_of(
    armature: Float[np.ndarray, "d d"] | Float[np.ndarray, " d"], rates: Any, coupled: Sequence[Pair]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " pairs"]]:
    """Returns I and the entries of C that produce this armature.

    Raises:
        InputError: the motors and pairs cannot have this armature.
    """
    A = np.asarray(armature, float)
    if A.ndim == 1:
        return A, np.zeros(len(coupled))  # inertias of the motors, whatever they turn
    if rates is not None:
        back = np.linalg.inv(np.asarray(rates, float))
        A = back.T @ A @ back
    rest = A - np.diag(np.diag(A))
    entries = np.array([rest[pair] for pair in coupled])
    for i, j in coupled:
        rest[i, j] = rest[j, i] = 0.0
    if np.abs(rest).max(initial=0.0) > 1e-9 * max(np.abs(A).max(initial=0.0), np.finfo(float).tiny):
        i, j = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
        raise InputError(
            f"the robot's armature couples joints {min(i, j) + 1} and {max(i, j) + 1}, but the stated motors do not; "
            f"state their rates (--motors), or couple them (--coupled {min(i, j) + 1}:{max(i, j) + 1})"
        )
    return np.diag(A).copy(), entries


def single_motors(armature: Any) -> tuple[Float[np.ndarray, " d"], list[tuple[float, Float[np.ndarray, " d"]]]]:
    """Splits A = diag(a) + sum of I c cᵀ: armatures a of the joints, and motors of inertia I that turn at c qd.

    Eliminating from the last joint on gives c = row of S for triangular S. As A is positive semidefinite, a >= 0.
    """
    A, motors = np.array(armature, float), []
    if A.ndim == 1:
        return A, motors
    largest = np.abs(A).max()
    for k in reversed(range(len(A))):
        if np.abs(np.delete(A[k], k)).max(initial=0.0) > 1e-12 * largest:
            inertia, coefficients = float(A[k, k]), A[k] / A[k, k]
            motors.append((inertia, coefficients))
            A -= inertia * np.outer(coefficients, coefficients)
            A[k] = A[:, k] = 0.0
    return np.maximum(np.diag(A), 0.0), motors[::-1]
