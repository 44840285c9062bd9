"""The names of optimisers, which command lines take and stored settings have; everywhere else they are records."""

from typing import Any

from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.precision import require_float64
from dln_jax.types import InputError

NAMES: dict[str, type[Optimiser]] = {"adam": Adam, "gauss-newton": GaussNewton}


def optimiser_named(name: str, *, precision: str, **settings: Any) -> Optimiser:
    """The optimiser of a name, with those of the settings that it has; `None` is its default.

    Raises:
        InputError: an unknown name, settings out of range, or Gauss-Newton in another precision than f64.
    """
    if name not in NAMES:
        raise InputError(f"optimizer is '{name}'; expected one of {', '.join(NAMES)}")
    kind = NAMES[name]
    if kind is GaussNewton:
        require_float64(precision)
    chosen = kind(**{key: settings[key] for key in kind._fields if settings.get(key) is not None})
    optimisers.check(chosen)
    return chosen


def name_of(optimiser: Optimiser | type[Optimiser]) -> str:
    """What a command line calls an optimiser."""
    kind = optimiser if isinstance(optimiser, type) else type(optimiser)
    return next(name for name, each in NAMES.items() if each is kind)
