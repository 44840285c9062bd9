"""The laws of friction in a joint, what numbers each takes, and which of those enter its force linearly.

With the joint's rate u, and v, w, a, s the velocity scale, Stribeck's velocity, the sigmoid's slope and its shift,

| law | force | linear in | depends otherwise on |
|---|---|---|---|
| viscous | b u | b | |
| coulomb | c tanh(u / v) | c | v |
| stribeck | c_s exp(-(u / w)²) tanh(u / v), on top of coulomb's | c_s, static less dry friction | v, w |
| offset | o | o | |
| asymmetric | b₊ u + c₊ forwards, b₋ u - c₋ backwards | b₊, b₋, c₊, c₋ | v |
| sigmoid | A / (1 + exp(-a (u + s))) - A / (1 + exp(-a s)) | A | a, s |
| load | μ abs(tau_link) tanh(u / v) | | v, and bilinear in μ and what tau_link is linear in |

Stribeck's is the usual form (Armstrong-Hélouvry, Dupont and Canudas de Wit 1994), the sigmoid that of Gaz et al. 2019
(RA-L, the Panda). The asymmetric law passes smoothly from one direction to the other: with t = tanh(u / v) and
k = u / √(u² + v²) it is

    b₊ u (1 + k)/2 + b₋ u (1 - k)/2 + c₊ t (1 + t)/2 + c₋ t (1 - t)/2

which with equal coefficients is viscous and coulomb, and takes power whatever they are.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, get_args

from dln_jax.types import FrictionLaw, InputError

LAWS: tuple[FrictionLaw, ...] = get_args(FrictionLaw)


class FrictionCoefficients(NamedTuple):
    """What friction is linear in: a number for each joint [d], or one for all; `None` for a law that is not there."""

    viscous: Any = None
    """b, N m s or N s/m."""
    coulomb: Any = None
    """c, N m or N."""
    offset: Any = None
    """o, N m or N: no loss, but what sensors and gears leave; the only one that may be negative."""
    stribeck: Any = None
    """c_s, N m or N, by which static friction exceeds dry friction."""
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
    """What friction is not linear in: a number for each joint [d], or one for all."""

    velocity_scale: Any = 0.01
    """v, 1/s or m/s, at which dry friction has 76 % of its force; a joint that rests creeps more slowly."""
    stribeck_velocity: Any = 0.1
    """w, 1/s or m/s."""
    sigmoid_slope: Any = 10.0
    """a, s or s/m."""
    sigmoid_shift: Any = 0.0
    """s, 1/s or m/s; it may be negative."""


COEFFICIENTS: Mapping[FrictionLaw, tuple[str, ...]] = {
    "viscous": ("viscous",),
    "coulomb": ("coulomb",),
    "stribeck": ("stribeck",),
    "offset": ("offset",),
    "asymmetric": ("viscous_forward", "viscous_backward", "coulomb_forward", "coulomb_backward"),
    "sigmoid": ("sigmoid",),
    "load": (),
}
"""Of each law, in `FrictionCoefficients`."""
SHAPE: Mapping[FrictionLaw, tuple[str, ...]] = {
    "viscous": (),
    "coulomb": ("velocity_scale",),
    "stribeck": ("velocity_scale", "stribeck_velocity"),
    "offset": (),
    "asymmetric": ("velocity_scale",),
    "sigmoid": ("sigmoid_slope", "sigmoid_shift"),
    "load": ("velocity_scale",),
}
"""Of each law, in `FrictionShape`."""


def coefficients_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Names of the coefficients that some laws take, in the order of `FrictionCoefficients`."""
    named = {name for law in laws for name in COEFFICIENTS[law]}
    return tuple(name for name in FrictionCoefficients._fields if name in named)


def shape_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Names of the numbers of shape that some laws take, in the order of `FrictionShape`."""
    named = {name for law in laws for name in SHAPE[law]}
    return tuple(name for name in FrictionShape._fields if name in named)


def require_laws(laws: Any, name: str) -> None:
    """Raises `InputError` unless each of these is a law, once, and no two are the same friction."""
    if unknown := [law for law in laws if law not in LAWS]:
        raise InputError(f"{name} has {unknown[0]!r:.40}; expected some of {', '.join(LAWS)}")
    if len(set(laws)) < len(laws):
        raise InputError(f"{name} is {list(laws)}; expected each law once")
    if "asymmetric" in laws and (twice := [law for law in ("viscous", "coulomb") if law in laws]):
        raise InputError(
            f"{name} has asymmetric and {' and '.join(twice)}, which no data can tell apart; leave one out: asymmetric "
            "has both frictions, in each direction"
        )
