"""Names of optimisers in command lines and stored settings; everywhere else optimisers are records."""

from typing import Any

from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser
from dln_jax.precision import require_float64
from dln_jax.types import InputError

NAMES: dict[str, type[Optimiser]] = {"adam": Adam, "gauss-newton": GaussNewton}


def optimiser_named(name: str, *, precision: str, **settings: Any) -> Optimiser:
    """Builds an optimiser by name. Settings that it lacks are ignored; a setting of `None` takes its default.

    Raises:
        InputError: an unknown name, a setting out of range, or Gauss-Newton in a precision other than f64.
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
    """The name of an optimiser in command lines."""
    kind = optimiser if isinstance(optimiser, type) else type(optimiser)
    return next(name for name, optimiser_kind in NAMES.items() if optimiser_kind is kind)
