"""Friction laws of a joint, their coefficients, and which of them enter the force linearly.

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

Stribeck's is the usual form (Armstrong-Hélouvry, Dupont and Canudas de Wit 1994), the sigmoid that of Gaz et al. 2019
(RA-L, the Panda). The asymmetric law passes smoothly from one direction to the other: with t = tanh(u / v) and
k = u / √(u² + v²) it is

    b₊ u (1 + k)/2 + b₋ u (1 - k)/2 + c₊ t (1 + t)/2 + c₋ t (1 - t)/2

With equal coefficients this is viscous and coulomb; it dissipates power for any coefficients.
"""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, get_args

from dln_jax.types import FrictionLaw, InputError

LAWS: tuple[FrictionLaw, ...] = get_args(FrictionLaw)
USUAL: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "offset")
"""Friction of a joint where nothing else is known."""


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
    """v, 1/s or m/s, at which dry friction reaches 76 % of its force; a joint that sticks creeps more slowly."""
    stribeck_velocity: Any = 0.1
    """w, 1/s or m/s."""
    sigmoid_slope: Any = 10.0
    """a, s or s/m."""
    sigmoid_shift: Any = 0.0
    """s, 1/s or m/s; it may be negative."""


PARAMETERS: Mapping[FrictionLaw, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "viscous": (("viscous",), ()),
    "coulomb": (("coulomb",), ("velocity_scale",)),
    "stribeck": (("stribeck",), ("velocity_scale", "stribeck_velocity")),
    "offset": (("offset",), ()),
    "asymmetric": (
        ("viscous_forward", "viscous_backward", "coulomb_forward", "coulomb_backward"),
        ("velocity_scale",),
    ),
    "sigmoid": (("sigmoid",), ("sigmoid_slope", "sigmoid_shift")),
    "load": ((), ("velocity_scale",)),
}
"""Names in `FrictionCoefficients` and in `FrictionShape`, by law."""


def coefficients_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Returns the names of the laws' coefficients, in the order of `FrictionCoefficients`."""
    names = {name for law in laws for name in PARAMETERS[law][0]}
    return tuple(name for name in FrictionCoefficients._fields if name in names)


def shape_of(laws: Iterable[FrictionLaw]) -> tuple[str, ...]:
    """Returns the names of the laws' shape parameters, in the order of `FrictionShape`."""
    names = {name for law in laws for name in PARAMETERS[law][1]}
    return tuple(name for name in FrictionShape._fields if name in names)


def require_laws(laws: Any, name: str) -> None:
    """Raises `InputError` unless all are laws, without duplicates, and no two describe the same friction."""
    if unknown := [law for law in laws if law not in LAWS]:
        raise InputError(f"{name} has {unknown[0]!r:.40}; expected some of {', '.join(LAWS)}")
    if len(set(laws)) < len(laws):
        raise InputError(f"{name} is {list(laws)}; expected each law once")
    if "asymmetric" in laws and (twice := [law for law in ("viscous", "coulomb") if law in laws]):
        raise InputError(
            f"{name} has asymmetric and {' and '.join(twice)}, which no data can tell apart; leave one out: asymmetric "
            "has both frictions, in each direction"
        )
