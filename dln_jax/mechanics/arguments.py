"""What a caller gives as one state: converted to vectors of one floating type, or refused in one line.

This is for the edge, where functions are handed out; the mechanics behind it checks nothing. Shapes are static, so that
a compiled function pays nothing for it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer

from dln_jax.types import InputError

Answer = TypeVar("Answer")


def vectors(size: int | None = None, /, **given: Any) -> tuple[Array, ...]:
    """The arguments as vectors [size] of one floating type, in the order given.

    The type is the widest floating one among them, and JAX's own for whole numbers.

    Args:
        size: of each; without it, whatever the first one has.
        given: by their names, anything; `types.VectorLike` is what passes.

    Raises:
        InputError: names the argument that holds no real numbers, or has another shape; a batch is for `jax.vmap`.
    """
    arrays = {name: _real_array(name, value) for name, value in given.items()}
    expected = None if size is None else (size,)
    for name, array in arrays.items():
        require_shape(name, array.shape, expected)
        expected = array.shape
    common = jnp.result_type(float, *arrays.values())
    return tuple(array.astype(common) for array in arrays.values())


@dataclass(frozen=True, eq=False)
class OfSize:
    """A function of vectors [size], which refuses others."""

    function: Callable[..., Any]
    size: int

    def __call__(self, *state: Array) -> Any:
        """The function's value; `InputError` for vectors of another size."""
        for each in state:
            require_shape("a state of this model", each.shape, (self.size,))
        return self.function(*state)


def require_size_of(energy: Callable[..., Any], size: int) -> None:
    """Raises `InputError` unless an energy (q, x) takes vectors [size].

    It does not if it reads entries beyond them, or if it depends on neither q nor x of some coordinate. The first is
    found where the energy takes NumPy's arrays, the second where it depends on nothing that is traced.
    """
    q, x = 0.3 + 0.1 * np.arange(size), 0.7 + 0.2 * np.arange(size)
    wrong = f"the system takes no states of size {size}"
    try:
        jax.eval_shape(lambda: energy(q, x))
    except IndexError as error:  # of NumPy's arrays, where JAX takes the last element
        raise InputError(f"{wrong} ({error}); give vectors [d] of its own size") from error
    except Exception:  # an energy need not take NumPy's arrays
        pass
    with jax.ensure_compile_time_eval():
        slopes = jax.jit(jax.grad(energy, argnums=(0, 1)))(jnp.asarray(q), jnp.asarray(x))
    if any(isinstance(slope, Tracer) for slope in slopes):
        return
    # A coordinate may be without a potential or, where the mass matrix is singular, without inertia, but not both.
    if not (read := np.any(slopes, axis=0)).all():
        unused = ", ".join(str(k) for k in np.flatnonzero(~read))
        raise InputError(f"{wrong}: its energy does not depend on coordinate {unused} (counted from 0) or its rate")


def answer(function: Callable[..., Answer], *state: Array) -> Answer:
    """What a system's function answers to vectors of one size.

    Raises:
        InputError: the system is of another size, as its own operations on arrays then say.
    """
    try:
        return function(*state)
    except InputError:
        raise
    except (TypeError, ValueError, IndexError) as error:
        reason = str(error).splitlines()[0] if str(error) else ""
        if not any(word in reason.lower() for word in ("shape", "dimension", "index")):
            raise
        raise InputError(
            f"the system takes no states of size {state[0].shape[0]} ({reason[:200]}); give vectors [d] of its own size"
        ) from error


def require_shape(name: str, shape: tuple[int, ...], expected: tuple[int, ...] | None) -> None:
    """Raises `InputError` unless an argument has this shape, or, for `None`, is a vector of some length."""
    if len(shape) == 1 and shape[0] > 0 if expected is None else shape == expected:
        return
    wanted = "[d]" if expected is None else str(expected)
    raise InputError(f"{name} has shape {shape}; expected {wanted}, and jax.vmap for a batch")


def _real_array(name: str, value: Any) -> Array:
    try:
        array = jnp.asarray(value)
    except (TypeError, ValueError, OverflowError) as error:
        kind = "None" if value is None else f"a {type(value).__name__} that makes no array"
        raise InputError(f"{name} is {kind}; expected one vector of real numbers") from error
    if not (jnp.issubdtype(array.dtype, jnp.floating) or jnp.issubdtype(array.dtype, jnp.integer)):
        raise InputError(f"{name} has type {array.dtype}; expected one vector of real numbers")
    return array
