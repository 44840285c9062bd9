"""Single and double precision: their names, and what needs which."""

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp

from dln_jax.types import InputError

KINDS = {"f32": jnp.float32, "f64": jnp.float64}


def data_type(precision: str) -> Any:
    """float32 or float64, for "f32" or "f64".

    Raises:
        InputError: another name, or f64 while JAX computes in 32 bits.
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
    """Raises `InputError` that says how to switch on double precision, where JAX computes in 32 bits.

    The setting is the process's, which a caller's own arrays, `vmap` and `grad` follow: the caller sets it.
    """
    if not jax.config.read("jax_enable_x64"):
        raise InputError(
            f"{what} needs double precision, which JAX leaves off; "
            'add `jax.config.update("jax_enable_x64", True)` behind the imports'
        )


def require_float64(precision: str) -> None:
    """Raises `InputError` unless the precision is f64, which Gauss-Newton needs."""
    if precision != "f64":
        raise InputError(f"precision is {precision}; gauss-newton needs f64, as it squares condition numbers")


@contextmanager
def computing_in(precision: str) -> Iterator[None]:
    """JAX in f32 or f64, whatever its own setting is.

    JAX keeps a NumPy array that a function closes over in the precision in which it met it first (as of 0.11, by the
    array's identity), and a function that is jitted in both gets constants of the wrong one. So where the setting is
    another, all that JAX has compiled is forgotten on both sides. Traced programs must not outlive the context.
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
    """Computes in float64, whatever the caller's default is."""

    @functools.wraps(function)
    def wrapped(*arguments, **keywords):
        with jax.enable_x64(True):
            return function(*arguments, **keywords)

    return cast(Function, wrapped)


def with_float64(parameters: Any) -> Any:
    """Parameters in float64, where JAX computes in it."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)
