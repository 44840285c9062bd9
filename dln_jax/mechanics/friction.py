"""Friction laws of a joint and their coefficients, linear and nonlinear.

With the joint's rate u, and v, w, a, s the velocity scale, Stribeck's velocity, the sigmoid's slope and its shift,

| law | force | linear in | other parameters |
|---|---|---|---|
| viscous | b u | b | |
| coulomb | c tanh(u / v) | c | v |
| stribeck | c_s exp(-(u / w)²) tanh(u / v), on top of coulomb | c_s, static minus dry friction | v, w |
| offset | o | o | |
| asymmetric | b₊ u + c₊ forwards, b₋ u - c₋ backwards | b₊, b₋, c₊, c₋ | v |
| sigmoid | A / (1 + exp(-a (u + s))) - A / (1 + exp(-a s)) | A | a, s |
| load | μ abs(tau_link) tanh(u / v) | | v, and bilinear in μ and the parameters of tau_link |

The Stribeck law has the usual form (Armstrong-Hélouvry, Dupont and Canudas de Wit 1994). The sigmoid comes from Gaz et
al. 2019 (RA-L, for the Panda). The asymmetric law changes smoothly between the directions: with t = tanh(u / v) and k =
u / √(u² + v²) it is

    b₊ u (1 + k)/2 + b₋ u (1 - k)/2 + c₊ t (1 + t)/2 + c₋ t (1 - t)/2

With equal coefficients this is viscous and coulomb; it dissipates power for any coefficients.

Every law derives from a Rayleigh function D in W, the integral of the force over the rate from rest. The force has its
own formula, because terms cancel in the derivative of the integral. Higher derivatives are exact derivatives of the
force.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero

from dln_jax.types import Dissipation, FrictionLaw, InputError, Scalar, Vector

LAWS: tuple[FrictionLaw, ...] = get_args(FrictionLaw)
USUAL: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "offset")
"""Default friction laws of a joint."""


class FrictionCoefficients(NamedTuple):
    """Linear parameters of friction: one number per joint [d], or one for all; `None` for absent laws."""

    viscous: Any = None
    """b, N m s or N s/m."""
    coulomb: Any = None
    """c, N m or N."""
    offset: Any = None
    """o, N m or N: an offset of sensors and gears, not a loss; the only coefficient that may be negative."""
    stribeck: Any = None
    """c_s, N m or N, static minus dry friction."""
    viscous_forward: Any = None
    """b₊, N m s or N s/m."""
    viscous_backward: Any = None
    """b₋, N m s or N s/m."""
    coulomb_forward: Any = None
    """c₊, N m or N."""
    coulomb_backward: Any = None
    """c₋, N m or N."""
    sigmoid: Any = None
    """A, N m or N."""


class FrictionShape(NamedTuple):
    """Nonlinear parameters of friction: one number per joint [d], or one for all."""

    velocity_scale: Any = 0.01
    """v, 1/s or m/s: dry friction reaches 76 % of its force there. A sticking joint creeps more slowly than v."""
    stribeck_velocity: Any = 0.1
    """w, 1/s or m/s."""
    sigmoid_slope: Any = 10.0
    """a, s or s/m."""
    sigmoid_shift: Any = 0.0
    """s, 1/s or m/s; it may be negative."""


PARAMETERS: Mapping[FrictionLaw, tuple[str, ...]] = {
    "viscous": ("viscous",),
    "coulomb": ("coulomb", "velocity_scale"),
    "stribeck": ("stribeck", "velocity_scale", "stribeck_velocity"),
    "offset": ("offset",),
    "asymmetric": ("viscous_forward", "viscous_backward", "coulomb_forward", "coulomb_backward", "velocity_scale"),
    "sigmoid": ("sigmoid", "sigmoid_slope", "sigmoid_shift"),
    "load": ("velocity_scale",),
}
"""Names in `FrictionCoefficients` and in `FrictionShape`, by law."""


def coefficients_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Returns the names of the laws' coefficients, in the order of `FrictionCoefficients`."""
    return _in_laws(laws, FrictionCoefficients._fields)


def shape_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Returns the names of the laws' shape parameters, in the order of `FrictionShape`."""
    return _in_laws(laws, FrictionShape._fields)


def _in_laws(laws: Iterable[FrictionLaw], names: tuple[str, ...]) -> tuple[str, ...]:
    used = {name for law in laws for name in PARAMETERS[law]}
    return tuple(name for name in names if name in used)


def require_laws(laws: Any, name: str) -> None:
    """Raises `InputError` for unknown or repeated laws, and for two laws that describe the same friction."""
    if unknown := [law for law in laws if law not in LAWS]:
        raise InputError(f"{name} has {unknown[0]!r:.40}; expected some of {', '.join(LAWS)}")
    if len(set(laws)) < len(laws):
        raise InputError(f"{name} is {list(laws)}; expected each law once")
    if "asymmetric" in laws and (twice := [law for law in ("viscous", "coulomb") if law in laws]):
        raise InputError(
            f"{name} has asymmetric and {' and '.join(twice)}, and no data can tell them apart; leave "
            f"{' and '.join(twice)} out: asymmetric has viscous and dry friction in each direction"
        )


NODES, WEIGHTS = (0.5 * (x + shift) for x, shift in zip(np.polynomial.legendre.leggauss(40), (1, 0), strict=True))
"""Gauss-Legendre nodes and weights on [0, 1]; exact to rounding for the integrands here."""


def integral(value: Callable[..., Array], slope: Callable[..., Array]) -> Callable[..., Array]:
    """Returns the function value(x, *rest), elementwise in x, with the derivative `slope(x, *rest)` by x."""
    function = jax.custom_jvp(value)

    def rule(primals, tangents):
        x, *rest = primals
        change, *others = tangents
        result = function(*primals)
        total = jnp.zeros_like(result) if isinstance(change, SymbolicZero) else slope(*primals) * change
        if rest and not any(isinstance(other, SymbolicZero) for other in others):
            # Derivatives by the arguments after x come from the integral.
            total = total + jax.jvp(partial(value, x), tuple(rest), tuple(others))[1]
        return result, total

    function.defjvp(rule, symbolic_zeros=True)
    return function


def _log_cosh(x: Vector) -> Vector:
    """Returns log cosh x without cosh, which overflows."""
    return jnp.logaddexp(x, -x) - jnp.log(jnp.asarray(2.0, x.dtype))


def _dry(side: int) -> Callable[[Vector], Vector]:
    """Returns dry friction in one direction: (1 ± tanh x)/2 is 1 on that side of rest and 0 on the other."""
    return integral(
        lambda x: 0.5 * (_log_cosh(x) + side * (x - jnp.tanh(x))),
        lambda x: jnp.tanh(x) * (0.5 * (1 + side * jnp.tanh(x))),
    )


def _one_sided(side: int) -> Callable[[Vector], Vector]:
    return integral(
        lambda x: 0.25 * (x**2 + side * (x * jnp.sqrt(1 + x**2) - jnp.arcsinh(x))),
        lambda x: 0.5 * x * (1 + side * x / jnp.sqrt(1 + x**2)),
    )


def _stribeck_value(x: Vector, ratio: Vector) -> Vector:
    """Returns √π/2 erf|x| minus the integral of exp(-s²) (1 - tanh(s / ratio)), which vanishes away from rest."""
    size = jnp.abs(x)
    reach = jnp.minimum(size, jnp.minimum(20 * ratio, 7.0))[..., None]
    s = reach * jnp.asarray(NODES, x.dtype)
    missing = 2 * jnp.exp(-(s**2)) * jax.nn.sigmoid(-2 * s / ratio[..., None])
    return 0.5 * math.sqrt(math.pi) * jax.scipy.special.erf(size) - jnp.sum(
        reach * jnp.asarray(WEIGHTS, x.dtype) * missing, axis=-1
    )


_unit_stribeck = integral(_stribeck_value, lambda x, ratio: jnp.exp(-(x**2)) * jnp.tanh(x / ratio))
_unit_sigmoid = integral(
    lambda x, shift: jax.nn.softplus(x + shift) - jax.nn.softplus(shift) - x * jax.nn.sigmoid(shift),
    lambda x, shift: jax.nn.sigmoid(x + shift) - jax.nn.sigmoid(shift),
)


def _stribeck(u: Vector, shape: FrictionShape) -> Vector:
    w = shape.stribeck_velocity
    return w * _unit_stribeck(u / w, jnp.broadcast_to(jnp.asarray(shape.velocity_scale / w, u.dtype), u.shape))


def _sigmoid(u: Vector, shape: FrictionShape) -> Vector:
    a = shape.sigmoid_slope
    return _unit_sigmoid(a * u, jnp.broadcast_to(jnp.asarray(a * shape.sigmoid_shift, u.dtype), u.shape)) / a


def _scaled(function: Callable[[Vector], Vector], power: int = 1) -> Callable[[Vector, FrictionShape], Vector]:
    """vⁿ f(u / v)."""
    return lambda u, shape: shape.velocity_scale**power * function(u / shape.velocity_scale)


POTENTIALS: Mapping[str, Callable[[Vector, FrictionShape], Vector]] = {
    "viscous": lambda u, shape: 0.5 * u**2,
    "coulomb": _scaled(integral(_log_cosh, jnp.tanh)),
    "offset": lambda u, shape: u,
    "stribeck": _stribeck,
    "viscous_forward": _scaled(_one_sided(1), 2),
    "viscous_backward": _scaled(_one_sided(-1), 2),
    "coulomb_forward": _scaled(_dry(1)),
    "coulomb_backward": _scaled(_dry(-1)),
    "sigmoid": _sigmoid,
}
"""Name of a coefficient -> Rayleigh function of the joints [d], in W, for a unit coefficient."""


def unit_force(coefficient: str, u: Vector, shape: FrictionShape) -> Vector:
    """Returns the force [..., d] of a unit coefficient at rates u [..., d]."""
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

    D is the Rayleigh function of all joints: the friction force dD/dqd is exactly the sum of the laws in the table of
    `mechanics.friction`. D is smooth at rest. It is non-negative for non-negative coefficients, except for the offset,
    which is not a loss.

    Args:
        viscous, coulomb, offset, stribeck: as in `FrictionCoefficients`; one per joint [d] or one for all.
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid: likewise.
        velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift: as in `FrictionShape`.
        joint_map: known matrix J [d, d] in joint rates = J qd; the force is Jᵀ dD/du.

    Raises:
        InputError: a known coefficient is negative or not finite, or a known velocity or slope is not positive.

    Example:
        >>> import dln_jax
        >>> D = dln_jax.joint_dissipation(viscous=[0.5, 0.1], coulomb=2.0)  # N m s, N m
        >>> arm = dln_jax.dynamics(dln_jax.LagrangianSystem(lambda q, qd: 0.5 * qd @ qd, D))
        >>> print(arm.friction([0.0, 0.0], [1.0, -1.0]).round(2))
        [ 2.5 -2.1]
    """
    coefficients = FrictionCoefficients(
        viscous, coulomb, offset, stribeck,
        viscous_forward, viscous_backward, coulomb_forward, coulomb_backward, sigmoid,
    )  # fmt: skip
    shape = FrictionShape(velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift)
    require_shape(shape)
    terms: dict[str, Any] = {}
    for name, value in coefficients._asdict().items():
        loss = name != "offset"
        known = _known(name, value, "finite numbers" + " of at least 0" * loss, 0.0 if loss else -np.inf)
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
    """Raises `InputError` if a known velocity or slope is not positive, or a shift is not finite."""
    for name, value in shape._asdict().items():
        kind, least = ("finite", -np.inf) if name == "sigmoid_shift" else ("positive", np.finfo(float).tiny)
        _known(name, value, f"a {kind} number, or one for each joint", least)


def _known(name: str, value: Any, expected: str, least: float) -> np.ndarray | None:
    """Returns known numbers as an array and `None` for traced ones; `InputError` if one is not finite or too small."""
    if not isinstance(value, int | float | np.ndarray | np.generic | list | tuple):
        return None
    known = np.asarray(value, float)
    if not (np.isfinite(known) & (known >= least)).all():
        raise InputError(f"{name} is {value}; expected {expected}")
    return known
