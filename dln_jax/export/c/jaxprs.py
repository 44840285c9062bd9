"""Jaxprs: how to make them, which calls they repeat, and which line of Python made an equation."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend import core

from dln_jax.types import InputError

_LARGE_CALL = 600
"""A jitted function with at least this many equations that is called several times becomes a C function."""


def traced(function: Callable[..., Any], examples: Sequence[Any]) -> tuple[Any, Any]:
    """Returns the closed jaxpr of a function, and the tree of its results.

    Raises:
        InputError: the function has side effects, integers beyond 64 bits, or branches of Python on an argument.
    """
    try:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
    except jax.errors.ConcretizationTypeError as error:
        raise InputError(
            "the function needs the value of an argument in Python, such as for `if x > 0`; write jnp.where or lax.cond"
        ) from error
    except OverflowError as error:
        raise InputError(f"a whole number is out of range ({error}); C has integers of up to 64 bits") from error
    if closed.effects:
        raise InputError(f"the function has side effects ({', '.join(map(str, closed.effects))}); C export takes none")
    return closed, shapes


def repeated_calls(every: Sequence[Any]) -> set[int]:
    """Returns the `id` values of large jaxprs that these closed jaxprs call several times.

    Calls of one jitted function with arguments of equal types share a jaxpr, which JAX keeps.
    """
    sizes: dict[int, int] = {}
    counts: Counter[int] = Counter()

    def size(jaxpr: Any) -> int:
        """Returns the number of equations, including those of calls."""
        if id(jaxpr) not in sizes:
            total = 0
            for equation in closed_jaxpr(jaxpr).jaxpr.eqns:
                values = equation.params.values() if _of_jax(equation.primitive) else ()
                inside = [inner for value in values for inner in _jaxprs(value)]
                counts.update(map(id, inside))
                total += max(1, sum(map(size, inside)))
            sizes[id(jaxpr)] = total
        return sizes[id(jaxpr)]

    for closed in every:
        size(closed)
    return {identity for identity, count in counts.items() if count > 1 and sizes[identity] >= _LARGE_CALL}


def _jaxprs(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return [jaxpr for item in value for jaxpr in _jaxprs(item)]
    return [value] if hasattr(value, "eqns") or hasattr(value, "jaxpr") else []


def expanded(primitive: Any) -> Any:
    """Returns a high-level primitive of JAX 0.11, such as `custom_root`, as a jaxpr of ordinary primitives."""

    def expand(*leaves: Any) -> list[Any]:
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, leaves)))

    examples = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in primitive.in_avals_flat]
    return jax.make_jaxpr(expand)(*examples)


def implementation(equation: Any, known: Sequence[Any]) -> Any | None:
    """Returns the jaxpr of the `impl` of another library's primitive, such as Equinox's; None for JAX's primitives.

    Args:
        equation: equation that applies the primitive.
        known: values of constant arguments; None for the others, which become arguments of the jaxpr.
    """
    primitive = equation.primitive
    if _of_jax(primitive):
        return None

    def run(*unknown: Any) -> list[Any]:
        left = iter(unknown)
        args = [next(left) if value is None else value for value in known]
        return jax.tree.leaves(primitive.impl(*args, **equation.params))

    avals = [variable.aval for variable, value in zip(equation.invars, known, strict=True) if value is None]
    return jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals))


def _of_jax(primitive: Any) -> bool:
    return getattr(primitive.impl, "func", primitive.impl).__module__.partition(".")[0] == "jax"


def is_error_of_equinox(equation: Any) -> bool:
    """Returns whether an equation is the callback that raises the error of `equinox.error_if`."""
    if equation.primitive.name != "pure_callback":
        return False
    callback = equation.params["callback"]
    return getattr(callback, "callback_func", callback).__module__ == "equinox._errors"


def closed_jaxpr(jaxpr: Any) -> Any:
    """Returns a jaxpr in closed form; an open jaxpr has no constants."""
    return jaxpr if hasattr(jaxpr, "consts") else core.ClosedJaxpr(jaxpr, ())


def made_at(equation: Any) -> str:
    """Returns " (made at FILE:LINE)" for the user's code that made an equation, or "" if JAX kept no traceback."""
    traceback = equation.source_info.traceback
    frames = [] if traceback is None else list(traceback.frames)
    users = [frame for frame in frames if "/jax/" not in frame.file_name and "/dln_jax/export/" not in frame.file_name]
    return f" (made at {users[0].file_name}:{users[0].line_num})" if users else ""
