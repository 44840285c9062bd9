"""What jaxprs say about themselves: how they are made, what they call, and where each equation comes from."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jax.extend import core

from dln_jax.types import InputError

_LARGE_CALL = 600
"""Equations from which on a jitted function that is called several times is a C function of its own."""


def traced(function: Callable[..., Any], examples: Sequence[Any]) -> tuple[Any, Any]:
    """The closed jaxpr of a function, and the tree of its results.

    Raises:
        InputError: side effects, or whole numbers beyond 64 bits.
    """
    try:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
    except OverflowError as error:
        raise InputError(f"a whole number is out of range ({error}); C has those of 64 bits") from error
    if closed.effects:
        raise InputError(f"the function has side effects ({', '.join(map(str, closed.effects))}); C export takes none")
    return closed, shapes


def repeated_calls(every: Sequence[Any]) -> dict[int, str]:
    """Jaxprs, by `id`, of jitted functions that are large and called several times by these closed ones; their text.

    Equal texts are equal functions.
    """
    texts: dict[int, str] = {}
    sizes: dict[int, int] = {}
    counts: Counter[str] = Counter()

    def visit(jaxpr: Any) -> int:
        """Number of equations, those of calls included."""
        size = 0
        for equation in jaxpr.eqns:
            key = id(equation.params["jaxpr"]) if equation.primitive.name in ("jit", "pjit") else None
            if key not in sizes:
                within = sum(visit(each) for value in equation.params.values() for each in _jaxprs(value))
                if key is not None and within >= _LARGE_CALL:
                    sizes[key], texts[key] = within, str(equation.params["jaxpr"])
            else:
                within = sizes[key]
            if key in texts:
                counts[texts[key]] += 1
            size += max(1, within)
        return size

    for closed in every:
        visit(closed.jaxpr)
    return {each: text for each, text in texts.items() if counts[text] > 1}


def _jaxprs(value: Any) -> list[Any]:
    if isinstance(value, list | tuple):
        return [each for one in value for each in _jaxprs(one)]
    value = getattr(value, "jaxpr", value)
    return [value] if hasattr(value, "eqns") else []


def expanded(primitive: Any) -> Any:
    """What JAX 0.11 keeps of a function with derivatives of its own, such as `custom_root`, in other primitives."""

    def expand(*leaves: Any) -> list[Any]:
        return jax.tree.leaves(primitive.expand(*jax.tree.unflatten(primitive.in_tree, leaves)))

    examples = [jax.ShapeDtypeStruct(each.shape, each.dtype) for each in primitive.in_avals_flat]
    return jax.make_jaxpr(expand)(*examples)


def closed_jaxpr(jaxpr: Any) -> Any:
    """With its constants, which an open one has not."""
    return jaxpr if hasattr(jaxpr, "consts") else core.ClosedJaxpr(jaxpr, ())


def made_at(equation: Any) -> str:
    """File and line of the user's code that made an equation, nothing where the call around it knows."""
    traceback = equation.source_info.traceback
    frames = [] if traceback is None else list(traceback.frames)
    users = [frame for frame in frames if "/jax/" not in frame.file_name and "/dln_jax/deploy/" not in frame.file_name]
    return f" (made at {users[0].file_name}:{users[0].line_num})" if users else ""


def scanned(equation: Any) -> dict[str, int]:
    """How many arguments of a scan are the same in each turn, and carried: releases of JAX state it differently.

    What is stacked has another shape outside than inside.
    """
    inner = closed_jaxpr(equation.params["jaxpr"]).jaxpr

    def alike(outside: Sequence[Any], inside: Sequence[Any]) -> int:
        return sum(a.aval.shape == b.aval.shape for a, b in zip(outside, inside, strict=True))

    carried = alike(equation.outvars, inner.outvars)
    return {"fixed": alike(equation.invars, inner.invars) - carried, "carried": carried}
