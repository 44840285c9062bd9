"""Friction of joints as a Rayleigh function D(q, qd), whose derivative by the velocity is the force."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.friction.curves import POTENTIALS
from dln_jax.mechanics.friction.laws import FrictionCoefficients, FrictionShape
from dln_jax.types import Dissipation, InputError, Scalar, Vector


def joint_dissipation(
    viscous: Any = None,
    coulomb: Any = None,
    offset: Any = None,
    *,
    stribeck: Any = None,
    viscous_forward: Any = None,
    viscous_backward: Any = None,
    coulomb_forward: Any = None,
    coulomb_backward: Any = None,
    sigmoid: Any = None,
    velocity_scale: Any = 0.01,
    stribeck_velocity: Any = 0.1,
    sigmoid_slope: Any = 10.0,
    sigmoid_shift: Any = 0.0,
    joint_map: Any = None,
) -> Dissipation | None:
    """(q, qd) -> D in W, or `None` if all coefficients are absent or known to be zero.

    D is the sum over joints of the laws' integrals. It is smooth at rest, and non-negative for non-negative
    coefficients (except the part of the offset, which is no loss). The force is exactly that of the formulas in
    `friction.laws`.

    Args:
        viscous, coulomb, offset, stribeck: as in `FrictionCoefficients`; one per joint [d] or one for all.
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid: likewise.
        velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift: as in `FrictionShape`.
        joint_map: known J [d, d] that maps rates of the coordinates to joint rates J qd; D(J qd), with the force
            Jᵀ dD/du.

    Raises:
        InputError: a known coefficient of friction that is negative or not finite, or a known velocity or slope that is
            not positive.
    """
    given = FrictionCoefficients(
        viscous, coulomb, offset, stribeck,
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid,
    )  # fmt: skip
    shape = FrictionShape(velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift)
    require_shape(shape)
    for name, value in given._asdict().items():
        known = _known(value)
        if known is not None and (not np.isfinite(known).all() or (name != "offset" and (known < 0).any())):
            raise InputError(
                f"{name} is {known}; expected finite numbers{', none of them negative' * (name != 'offset')}"
            )
    terms = {name: value for name, value in given._asdict().items() if value is not None and not _is_zero(value)}
    if not terms:
        return None

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        rates = joint_rates(joint_map, qd)
        shaped = FrictionShape(*(jnp.asarray(each, qd.dtype) for each in shape))
        parts = (
            jnp.sum(jnp.asarray(value, qd.dtype) * POTENTIALS[name](rates, shaped)) for name, value in terms.items()
        )
        return sum(parts, start=jnp.zeros((), qd.dtype))

    return dissipation


def joint_rates(joint_map: Any, qd: Vector) -> Vector:
    """Joint rates J qd [d]."""
    return qd if joint_map is None else jnp.asarray(joint_map, qd.dtype) @ qd


def require_shape(shape: FrictionShape) -> None:
    """Raises `InputError` for a known velocity or slope that is not positive, or a shift that is not finite."""
    for name, value in shape._asdict().items():
        known = _known(value)
        if known is None:
            continue
        if not np.isfinite(known).all() or (name != "sigmoid_shift" and not (known > 0).all()):
            kind = "finite" if name == "sigmoid_shift" else "positive"
            raise InputError(f"{name} is {value}; expected a {kind} number, or one for each joint")


def _known(given: Any) -> np.ndarray | None:
    return (
        None
        if not isinstance(given, int | float | np.ndarray | np.generic | list | tuple)
        else np.asarray(given, float)
    )


def _is_zero(given: Any) -> bool:
    known = _known(given)
    return known is not None and not known.any()
