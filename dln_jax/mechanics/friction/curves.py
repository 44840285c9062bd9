"""Rayleigh functions D(q, qd) of joint friction, whose derivatives with respect to velocity are the forces.

They consist of curves for unit coefficients, elementwise in the rate u of a joint. Every curve is the integral of its
force from rest. Its derivative is written out, because terms cancel in the derivative of the integral; higher
derivatives are exact derivatives of the force.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from dln_jax.mechanics.friction.laws import FrictionCoefficients, FrictionShape
from dln_jax.types import Dissipation, InputError, Scalar, Vector

NODES, WEIGHTS = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(40), (1, 0), strict=True))
"""Gauss-Legendre nodes and weights on [0, 1]; exact to rounding for the integrands here."""


def integral(value: Callable[..., Array], slope: Callable[..., Array]) -> Callable[..., Array]:
    """Returns the function value(x, *rest), elementwise in x, whose derivative by x is `slope(x, *rest)`."""
    function = jax.custom_jvp(value)

    def rule(primals, tangents):
        x, *rest = primals
        change, *others = tangents
        result = function(*primals)
        total = jnp.zeros_like(result) if isinstance(change, SymbolicZero) else slope(*primals) * change
        for place, other in enumerate(others):
            if not isinstance(other, SymbolicZero):
                # Derivatives by the arguments after x come from the integral.
                moved = lambda r, place=place: value(x, *rest[:place], r, *rest[place + 1 :])  # noqa: E731
                total = total + jax.jvp(moved, (rest[place],), (other,))[1]
        return result, total

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _log_cosh(x: Vector) -> Vector:
    """Returns log cosh x without cosh, which overflows."""
    return jnp.logaddexp(x, -x) - jnp.log(jnp.asarray(2.0, x.dtype))


def _towards(side: int) -> Callable[[Vector], Vector]:
    """Returns (1 ± tanh x)/2: 1 on one side of rest and 0 on the other."""
    return lambda x: 0.5 * (1 + side * jnp.tanh(x))


def _dry(side: int) -> Callable[[Vector], Vector]:
    return integral(
        lambda x: 0.5 * (_log_cosh(x) + side * (x - jnp.tanh(x))), lambda x: jnp.tanh(x) * _towards(side)(x)
    )


def _one_sided(side: int) -> Callable[[Vector], Vector]:
    def value(x: Vector) -> Vector:
        return 0.25 * (x**2 + side * (x * jnp.sqrt(1 + x**2) - jnp.arcsinh(x)))

    return integral(value, lambda x: 0.5 * x * (1 + side * x / jnp.sqrt(1 + x**2)))


def _stribeck_value(x: Vector, ratio: Vector) -> Vector:
    """Returns √π/2 erf|x| minus the integral of exp(-s²) (1 - tanh(s / ratio)), which vanishes away from rest."""
    size = jnp.abs(x)
    reach = jnp.minimum(size, jnp.minimum(20 * ratio, 7.0))[..., None]
    s = reach * jnp.asarray(NODES, x.dtype)
    missing = 2 * jnp.exp(-(s**2)) * jax.nn.sigmoid(-2 * s / ratio[..., None])
    return 0.5 * math.sqrt(math.pi) * jax.scipy.special.erf(size) - jnp.sum(
        reach * jnp.asarray(WEIGHTS, x.dtype) * missing, axis=-1
    )


def _sigmoid_value(x: Vector, shift: Vector) -> Vector:
    return jax.nn.softplus(x + shift) - jax.nn.softplus(shift) - x * jax.nn.sigmoid(shift)


log_cosh = integral(_log_cosh, jnp.tanh)
dry_forward, dry_backward = _dry(1), _dry(-1)
viscous_forward, viscous_backward = _one_sided(1), _one_sided(-1)
stribeck = integral(_stribeck_value, lambda x, ratio: jnp.exp(-(x**2)) * jnp.tanh(x / ratio))
sigmoid = integral(_sigmoid_value, lambda x, shift: jax.nn.sigmoid(x + shift) - jax.nn.sigmoid(shift))


def _stribeck(u: Vector, shape: FrictionShape) -> Vector:
    w = shape.stribeck_velocity
    return w * stribeck(u / w, jnp.broadcast_to(jnp.asarray(shape.velocity_scale / w, u.dtype), u.shape))


def _sigmoid(u: Vector, shape: FrictionShape) -> Vector:
    a = shape.sigmoid_slope
    return sigmoid(a * u, jnp.broadcast_to(jnp.asarray(a * shape.sigmoid_shift, u.dtype), u.shape)) / a


def _scaled(function: Callable[[Vector], Vector], power: int) -> Callable[[Vector, FrictionShape], Vector]:
    """vⁿ f(u / v)."""
    return lambda u, shape: shape.velocity_scale**power * function(u / shape.velocity_scale)


POTENTIALS: Mapping[str, Callable[[Vector, FrictionShape], Vector]] = {
    "viscous": lambda u, shape: 0.5 * u**2,
    "coulomb": _scaled(log_cosh, 1),
    "offset": lambda u, shape: u,
    "stribeck": _stribeck,
    "viscous_forward": _scaled(viscous_forward, 2),
    "viscous_backward": _scaled(viscous_backward, 2),
    "coulomb_forward": _scaled(dry_forward, 1),
    "coulomb_backward": _scaled(dry_backward, 1),
    "sigmoid": _sigmoid,
}
"""Rayleigh function, in W, of a unit coefficient by its name, [d] for the joints."""


def unit_force(coefficient: str, u: Vector, shape: FrictionShape) -> Vector:
    """Returns the force [d] of a unit coefficient at rates u [d]."""
    return jax.jvp(lambda rate: POTENTIALS[coefficient](rate, shape), (u,), (jnp.ones_like(u),))[1]


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
    """Returns (q, qd) -> D in W, or `None` if all coefficients are absent or known to be zero.

    D is the sum of the laws' integrals over all joints. It is smooth at rest, and non-negative for non-negative
    coefficients (except the part of the offset, which is not a loss). The force is exactly that in `friction.laws`.

    Args:
        viscous, coulomb, offset, stribeck: as in `FrictionCoefficients`; one per joint [d] or one for all.
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid: likewise.
        velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift: as in `FrictionShape`.
        joint_map: known J [d, d] that maps rates of the coordinates to joint rates J qd; the force is Jᵀ dD/du.

    Raises:
        InputError: a known coefficient is negative or not finite, or a known velocity or slope is not positive.
    """
    coefficients = FrictionCoefficients(
        viscous, coulomb, offset, stribeck,
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid,
    )  # fmt: skip
    shape = FrictionShape(velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift)
    require_shape(shape)
    terms: dict[str, Any] = {}
    for name, value in coefficients._asdict().items():
        known = _known(value)
        if known is not None and (not np.isfinite(known).all() or (name != "offset" and (known < 0).any())):
            raise InputError(
                f"{name} is {known}; expected finite numbers{', none of them negative' * (name != 'offset')}"
            )
        if value is not None and (known is None or known.any()):
            terms[name] = value
    if not terms:
        return None

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        rates = joint_rates(joint_map, qd)
        shaped = FrictionShape(*(jnp.asarray(value, qd.dtype) for value in shape))
        parts = (
            jnp.sum(jnp.asarray(value, qd.dtype) * POTENTIALS[name](rates, shaped)) for name, value in terms.items()
        )
        return sum(parts, start=jnp.zeros((), qd.dtype))

    return dissipation


def joint_rates(joint_map: Any, qd: Vector) -> Vector:
    """Returns the joint rates J qd [d]."""
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


def _known(value: Any) -> np.ndarray | None:
    numbers = isinstance(value, int | float | np.ndarray | np.generic | list | tuple)
    return np.asarray(value, float) if numbers else None
