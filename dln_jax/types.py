"""Symbols, units and shapes of the whole library.

| symbol | shape | unit | meaning |
|---|---|---|---|
| `d` | | | degrees of freedom |
| `N` | | | samples |
| `q` | [d] | rad or m | generalised coordinates |
| `qd`, `qdd` | [d] | 1/s, 1/s² | their first and second time derivatives |
| `p`, `pd` | [d] | | generalised momentum dL/dqd and its rate |
| `tau` | [d] | N m or N | generalised force |
| `M(q)` | [d, d] | | mass matrix |
| `c(q, qd)` | [d] | N m or N | Coriolis and centrifugal force |
| `g(q)` | [d] | N m or N | force of the potential ("gravity") |
| `dt` | | s | time step |

Equation of motion: `tau = M(q) qdd + c(q, qd) + g(q)`, plus `dD/dqd` where there is friction.
"""

import reprlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from dln_jax.errors import InputError as InputError

Scalar = Float[Array, ""]
Vector = Float[Array, "d"]
Matrix = Float[Array, "d d"]
JointVector = Float[np.ndarray, " d"]
"""One number per joint."""
JointSamples = Float[np.ndarray, "N d"]
SampleVector = Float[np.ndarray, " N"]
SampleIndex = Int[np.ndarray, " N"]
"""One index per sample, such as the number of its trajectory."""

VectorLike = ArrayLike | Sequence[ArrayLike]
"""Accepted types of a vector argument: an array, or a list or tuple of numbers."""

Lagrangian = Callable[[Array, Array], Array]
"""L(q, qd) -> scalar, in J."""
Hamiltonian = Callable[[Array, Array], Array]
"""H(q, p) -> scalar, in J."""
Potential = Callable[[Array], Array]
"""V(q) -> scalar, in J."""
Dissipation = Callable[[Array, Array], Array]
"""Rayleigh function D(q, qd) -> scalar, in W; friction takes the force dD/dqd."""
CholeskyFactor = Callable[[Array], Array]
"""q -> lower triangular L [d, d] with M(q) = L Lᵀ."""

JointKind = Literal["revolute", "prismatic"]
FrictionLaw = Literal["viscous", "coulomb", "stribeck", "offset", "asymmetric", "sigmoid", "load"]
"""Laws of friction in a joint; `mechanics.friction` has their formulas."""
ResidualTerm = Literal["potential", "dissipation", "inertia"]
"""Energies that a residual may have; `mechanics.residual` states what they explain."""


def require_positive(**numbers: int | float) -> None:
    """Raises `InputError` that names the first number that is not positive (NaN is not)."""
    for name, value in numbers.items():
        if not value > 0:
            raise InputError(f"{name} is {value}; expected a positive number")


def require_once(what: str, names: Sequence[str]) -> None:
    """Raises `InputError` for a repeated name, since only one of its values would count."""
    if twice := [name for place, name in enumerate(names) if name in names[:place]]:
        raise InputError(f"{what} names '{twice[0]:.60}' twice; expected once")


def finite_array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Converts a value to a finite float64 array of this shape; `InputError` for a wrong type, shape or number."""
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {reprlib.repr(value)}; expected real numbers of shape {shape}") from None
    if array.shape != shape:
        raise InputError(f"{name} has shape {array.shape}; expected {shape}")
    if len(wrong := np.argwhere(~np.isfinite(array))):
        place = tuple(map(int, wrong[0]))
        raise InputError(f"{name} has {array[place]} at {place}; expected finite numbers")
    return array


LARGEST_SEED = 2**32 - 1
"""Largest seed that NumPy and JAX accept, also in 32-bit mode."""


def require_seed(seed: int, seeds: int = 1) -> None:
    """Raises `InputError` unless `seed` and the `seeds` - 1 after it are whole numbers from 0 to 2³² - 1."""
    if not 0 <= seed <= LARGEST_SEED - (seeds - 1):
        counted = f" and {seeds - 1} after it" if seeds > 1 else ""
        raise InputError(f"seed is {seed}{counted}; expected whole numbers from 0 to {LARGEST_SEED}")


class _Needs(NamedTuple):
    """The fields of `Needs`."""

    joints: tuple[JointKind, ...]
    """Kinds of the joints: a revolute angle enters a model as cos and sin, a prismatic displacement unchanged."""
    gravity: bool = True
    """Whether the plant has a potential V(q) (weight, springs)."""
    friction: bool = False
    """Whether the plant has a Rayleigh dissipation function D(q, qd)."""
    actuation: tuple[tuple[float, ...], ...] | None = None
    """Rows of the matrix B [d, u] in tau = B control; `None` if every coordinate has its own motor."""
    joint_friction: tuple[FrictionLaw, ...] = ()
    """Friction laws of every joint; `friction` is a learned dissipation of general form instead."""
    joint_map: tuple[tuple[float, ...], ...] | None = None
    """Rows of the matrix J [d, d] in joint rates = J qd, for coordinates that are not joint angles, such as angles from
    the vertical; `None` if they are joint angles."""
    velocity_scale: float = 0.01
    """Velocity v of the joints' dry friction, rad/s or m/s; the law is smooth below it."""


class Needs(_Needs):
    """Joints of a plant and the terms in its equations of motion.

    Models never build, trace or compile a term that is absent here. The record is hashable and has plain Python values,
    so it can be a static argument of `jax.jit` and can be stored as JSON.

    Raises:
        InputError: unknown kinds of joints or laws of friction, or values of a wrong type.

    Example:
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("prismatic", "revolute"), joint_friction=("viscous", "coulomb"))
        >>> print(needs.degrees_of_freedom, needs.gravity, needs.friction)
        2 True False
    """

    __slots__ = ()

    def __new__(cls, *values: Any, **named: Any) -> "Needs":
        """Checks the fields."""
        fields = super().__new__(cls, *values, **named)
        joints = _names_of("joints", fields.joints, get_args(JointKind))
        if not joints:
            raise InputError("joints are empty; expected at least one")
        laws = _names_of("joint_friction", fields.joint_friction, get_args(FrictionLaw))
        for name in ("gravity", "friction"):
            if not isinstance(getattr(fields, name), bool):
                raise InputError(f"{name} is {reprlib.repr(getattr(fields, name))}; expected True or False")
        return super().__new__(cls, **{**fields._asdict(), "joints": joints, "joint_friction": laws})

    @classmethod
    def _make(cls, iterable: Iterable[Any]) -> "Needs":  # type: ignore[override]  # so that `_replace` checks too
        return cls(*iterable)

    @property
    def degrees_of_freedom(self) -> int:
        """Number of degrees of freedom, d."""
        return len(self.joints)


def _names_of(field: str, names: Any, known: tuple[str, ...]) -> tuple[Any, ...]:
    """Returns names as a tuple; `InputError` for an unknown name."""
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) and name in known for name in names):
        raise InputError(f"{field}: {reprlib.repr(names)}; expected a tuple of {', '.join(known)}")
    return tuple(names)
