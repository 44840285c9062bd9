"""How JAX computes: single or double precision, and XLA options for programs that run for seconds on a CPU."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp

from dln_jax.types import InputError

_OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
KINDS = {"f32": jnp.float32, "f64": jnp.float64}


def data_type(precision: str) -> Any:
    """float32 or float64, for "f32" or "f64".

    Raises:
        InputError: an unknown name, or f64 while JAX computes in 32 bits.
    """
    require_precision(precision)
    if precision == "f64":
        require_double_precision("f64")
    return KINDS[precision]


def require_precision(precision: Any) -> None:
    """Raises `InputError` unless the name is f32 or f64."""
    if precision not in tuple(KINDS):
        raise InputError(f"precision is {precision!r:.40}; expected f32 or f64")


def require_double_precision(what: str) -> None:
    """Raises `InputError` that states how to enable double precision, if JAX computes in 32 bits.

    The library does not enable it itself, because the setting affects the caller's own arrays and functions too.
    """
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            f"{what} needs double precision, which JAX disables by default; "
            'add `jax.config.update("jax_enable_x64", True)` after the imports'
        )


def require_float64(precision: str) -> None:
    """Raises `InputError` unless the precision is f64, which Gauss-Newton needs."""
    if precision != "f64":
        raise InputError(f"precision is {precision}; gauss-newton needs f64, as it squares condition numbers")


@contextmanager
def computing_in(precision: str) -> Iterator[None]:
    """Runs JAX in f32 or f64, regardless of its setting.

    JAX (as of 0.11) caches each NumPy array that a function closes over, by identity and in the precision of its first
    use. A function jitted in both precisions would get constants of the wrong one, so JAX's caches are cleared on entry
    and exit if the precision differs from the setting. Traced programs must not outlive the context.
    """
    differs = jax.config.read("jax_enable_x64") != (precision == "f64")
    if differs:
        jax.clear_caches()
    try:
        with jax.enable_x64(precision == "f64"):
            yield
    finally:
        if differs:
            jax.clear_caches()


Function = TypeVar("Function", bound=Callable)


def in_float64(function: Function) -> Function:
    """Decorates a function to compute in float64, regardless of the caller's setting."""

    @functools.wraps(function)
    def wrapped(*arguments, **keywords):
        with jax.enable_x64(True):
            return function(*arguments, **keywords)

    return cast(Function, wrapped)


def with_float64(parameters: Any) -> Any:
    """Converts parameters to JAX's default float: float64 if double precision is enabled."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)


def quick_compilation() -> dict[str, Any]:
    """Returns compiler options for `jax.jit` and `compile` that shorten compilation, if the installed XLA has them.

    With jaxlib 0.10.2 they cut the compilation time of a network's residuals by 40 % and its speed by at most 5 %; the
    optimisation level alone does not. jaxlib 0.11 cannot turn off the fusion emitters, and 10 % remain. Empty if the
    default device is not a CPU.
    """
    return dict(_known()) if jax.default_backend() == "cpu" else {}


def compiled(function: Callable[..., Any]) -> Any:
    """Applies `jax.jit` with quick compilation, for programs that run once or twice."""
    return jax.jit(function, compiler_options=quick_compilation())


@functools.cache
def _known() -> dict[str, Any]:
    known = {}
    for name, value in _OPTIONS.items():
        # XLA publishes no list of options: compile an empty program and see whether the option raises an error.
        try:
            jax.jit(lambda: 0).lower().compile({name: value})
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
        else:
            known[name] = value
    return known
