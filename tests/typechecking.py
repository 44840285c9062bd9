"""Types of the library's functions, checked by beartype: once for each function, however often it is defined."""

import inspect
from types import FunctionType

import jaxtyping
from beartype import beartype

_CHECKS = {}


def checked(function):
    """A function whose arguments and result are checked by beartype.

    For each function of the library jaxtyping makes two of the same signature, which only check. One that is defined
    within another is made again at every call of that one: its checks are those of the first time.
    """
    if not isinstance(function, FunctionType) or function.__code__.co_filename != "<string>":
        return beartype(function)
    code = function.__code__
    counts = code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount
    name = function.__module__, function.__qualname__, code.co_varnames, *counts
    try:
        key = name, tuple((argument, _same(hint)) for argument, hint in function.__annotations__.items())
        known = _CHECKS.get(key)
    except TypeError:  # a type that cannot be a key
        return beartype(function)
    if known is None:
        known = _CHECKS[key] = beartype(function)
    return known


def _same(hint):
    """Returns a key that is equal for equal array types: jaxtyping makes a new class for them each time."""
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return hint.array_type, hint.dtypes, hint.dim_str
    return hint
