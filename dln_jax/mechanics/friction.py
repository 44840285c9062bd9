"""Friction of joints as Rayleigh functions, whose slope by the velocity is the force.

    D = sum over joints of ½ b qd² + c v log cosh(qd / v) + o qd,   dD/dqd = b qd + c tanh(qd / v) + o

viscous, dry (Coulomb), and an offset that sensors and gears leave. Dry friction is smooth on the scale v of velocities,
within which a joint that rests creeps in place of sticking.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.types import Dissipation, InputError, Scalar, Vector, require_positive


def joint_dissipation(
    viscous: Any = 0.0, coulomb: Any = 0.0, offset: Any = 0.0, *, velocity_scale: float = 0.01
) -> Dissipation | None:
    """(q, qd) -> D in W, or `None` where all coefficients are known to be zero.

    Args:
        viscous: b, N m s or N s/m, one for each joint [d] or one for all.
        coulomb: c, N m or N.
        offset: o, N m or N; it is no loss, and D is not positive with it.
        velocity_scale: v, 1/s or m/s, at which dry friction has 76 % of its force.

    Raises:
        InputError: a known coefficient of friction that is negative or not finite, or a scale that is not positive.
    """
    require_positive(velocity_scale=velocity_scale)
    for name, given in (("viscous", viscous), ("coulomb", coulomb), ("offset", offset)):
        known = _known(given)
        if known is not None and (not np.isfinite(known).all() or (name != "offset" and (known < 0).any())):
            raise InputError(
                f"{name} is {known}; expected finite numbers{', none of them negative' * (name != 'offset')}"
            )
    terms = [given is not None and not _is_zero(given) for given in (viscous, coulomb, offset)]
    if not any(terms):
        return None

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        total = jnp.zeros((), qd.dtype)
        if terms[0]:
            total += 0.5 * jnp.sum(jnp.asarray(viscous, qd.dtype) * qd**2)
        if terms[1]:
            total += velocity_scale * jnp.sum(jnp.asarray(coulomb, qd.dtype) * _log_cosh(qd / velocity_scale))
        if terms[2]:
            total += jnp.sum(jnp.asarray(offset, qd.dtype) * qd)
        return total

    return dissipation


@jax.custom_jvp
def _log_cosh(x: Vector) -> Vector:
    """Without cosh, which overflows."""
    return jnp.logaddexp(x, -x) - jnp.log(jnp.asarray(2.0, x.dtype))


@_log_cosh.defjvp
def _slope(primals: tuple[Vector], tangents: tuple[Vector]) -> tuple[Vector, Vector]:
    (x,), (change,) = primals, tangents
    return _log_cosh(x), jnp.tanh(x) * change  # one function, of which all further derivatives are exact


def _known(given: Any) -> np.ndarray | None:
    return (
        None
        if not isinstance(given, int | float | np.ndarray | np.generic | list | tuple)
        else np.asarray(given, float)
    )


def _is_zero(given: Any) -> bool:
    known = _known(given)
    return known is not None and not known.any()
