"""Arguments of one state: converts them to vectors of one floating type, or refuses them in one line.

Public functions run these checks; the mechanics behind them checks nothing. Shapes are static, so a compiled function
runs no checks.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from dln_jax.types import InputError

Answer = TypeVar("Answer")


def vectors(size: int | None = None, /, **arguments: Any) -> tuple[Array, ...]:
    """Converts the arguments to vectors [size] of one floating type, in order.

    The type is the widest floating type among them, or JAX's default if all are integers.

    Args:
        size: size of all vectors; by default the size of the first.
        arguments: arguments by name; `types.VectorLike` is accepted.

    Raises:
        InputError: an argument is not real or has another shape; the message names it. Use `jax.vmap` for a batch.
    """
    arrays = {name: _real_array(name, value) for name, value in arguments.items()}
    expected = None if size is None else (size,)
    for name, array in arrays.items():
        require_shape(name, array.shape, expected)
        expected = array.shape
    common = jnp.result_type(float, *arrays.values())
    return tuple(array.astype(common) for array in arrays.values())


def require_size_of(energy: Callable[..., Any], size: int) -> None:
    """Raises `InputError` unless an energy (q, x) takes vectors [size].

    The energy must not read entries beyond `size`, and must depend on q or x of every coordinate. The first test needs
    an energy that accepts NumPy arrays, the second an energy without traced values.
    """
    q, x = 0.3 + 0.1 * np.arange(size), 0.7 + 0.2 * np.arange(size)
    wrong = f"the system does not take states of size {size}"
    try:
        jax.eval_shape(lambda: energy(q, x))
    except IndexError as error:  # NumPy arrays raise it; JAX would take the last element
        raise InputError(f"{wrong} ({error}); give vectors of its size") from error
    except Exception:  # an energy need not accept NumPy arrays
        pass
    with jax.ensure_compile_time_eval():
        slopes = jax.jit(jax.grad(energy, argnums=(0, 1)))(jnp.asarray(q), jnp.asarray(x))
    if any(isinstance(slope, Tracer) for slope in slopes):
        return
    # A coordinate may lack a potential or, if the mass matrix is singular, inertia, but not both.
    if not (read := np.any(slopes, axis=0)).all():
        unused = ", ".join(str(k) for k in np.flatnonzero(~read))
        raise InputError(f"{wrong}: its energy does not depend on coordinate {unused} (counted from 0) or its rate")


def answer(function: Callable[..., Answer], *state: Array) -> Answer:
    """Calls a system's function with vectors of one size.

    Raises:
        InputError: the system has another size, an energy is not a scalar, or a function of the system converts its
            arguments to NumPy. The message quotes the error of the array operation. Other errors pass through.
    """
    try:
        return function(*state)
    except InputError:
        raise
    except (TypeError, ValueError, IndexError) as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        if isinstance(error, jax.errors.JAXTypeError | jax.errors.JAXIndexError):
            raise InputError(
                f"a function of the system converts its arguments to NumPy or Python numbers ({reason[:200]}); use "
                "jax.numpy, without float() or `if` on them"
            ) from error
        if reason.startswith("Gradient only defined for scalar-output"):
            raise InputError(f"an energy of the system is not a scalar ({reason.partition('. To get')[0]})") from error
        words = ("shape", "dimension", "index")
        if "positional argument" in reason or not any(word in reason.lower() for word in words):
            raise
        raise InputError(
            f"the system does not take states of size {state[0].shape[0]} ({reason[:200]}); give vectors of its size"
        ) from error


def require_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...] | None) -> None:
    """Raises `InputError` unless an argument has this shape or, for `None`, is a vector of any length."""
    if len(shape) == 1 and shape[0] > 0 if expected is None else shape == expected:
        return
    wanted = "[d]" if expected is None else str(expected)
    raise InputError(f"{name} has shape {shape}; expected {wanted}, and jax.vmap for a batch")


def _real_array(name: str, value: Any) -> Array:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        kind = "None" if value is None else f"a {type(value).__name__} that is not an array"
        raise InputError(f"{name} is {kind}; expected one vector of real numbers") from error
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise InputError(f"{name} has type {array.dtype}; expected one vector of real numbers")
    return array
