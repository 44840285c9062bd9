"""Syntax of grids: `width=8,16 seed=0:10 data=a.npz,b.npz` means all combinations of these values."""

import itertools
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence

from dln_jax.types import InputError

RANGE = re.compile(r"(-?\d+):(-?\d+)(?::(-?\d+))?")
MOST_JOBS = 10_000
MOST_DIGITS = 60
"""Longest text of a range."""
EXAMPLE = "expected for example 'width=8,16 seed=0:10'"


def grid_of(text: str) -> dict[str, tuple[str, ...]]:
    """Parses a grid: values by option, in the order of the text.

    Spaces separate options, commas separate values; `a:b` and `a:b:step` are whole numbers that exclude b. Quotes
    protect spaces, as in a shell.

    Raises:
        InputError: empty or malformed text, a repeated option or value, an empty range, more than 10,000 combinations.
    """
    grid = {name: _values(name, values) for name, values in pairs("--grid", text).items()}
    if not grid:
        raise InputError(f"--grid names no option; {EXAMPLE}")
    jobs = 1
    for values in grid.values():
        jobs *= len(values)
    if jobs > MOST_JOBS:
        raise InputError(f"--grid has {jobs:,} combinations; expected at most {MOST_JOBS:,}; split it into several")
    return grid


def fixed_of(text: str) -> dict[str, str]:
    """Parses options common to all jobs; commas are part of a value: `steps=500 test=e,q,v`. Errors as `pairs`."""
    return pairs("--fixed", text)


def combinations(grid: Mapping[str, Sequence[str]]) -> list[dict[str, str]]:
    """All combinations of the values; the last option changes fastest."""
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def pairs(option: str, text: str) -> dict[str, str]:
    """Splits an option's text into NAME=VALUE pairs; `InputError` for other words and for repeated names."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"{option} is {text!r:.60}: {str(error).lower()}; close the quotes") from None
    found: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        name = name.removeprefix("--").replace("-", "_")
        if not equals or not name.isidentifier() or not value:
            raise InputError(f"{option} has {word!r:.60}, which is no NAME=VALUE; {EXAMPLE}")
        if name in found:
            raise InputError(f"{option} names {name} twice; give all its values at once")
        found[name] = value
    return found


def _values(name: str, text: str) -> tuple[str, ...]:
    found = []
    for part in text.split(","):
        if not part:
            raise InputError(f"--grid: {name}={text:.60} has an empty value; leave the comma out")
        found += _range(name, *match.groups()) if (match := RANGE.fullmatch(part)) else [part]
    for value, times in Counter(found).items():
        if times > 1:
            raise InputError(f"--grid: {name} has {value} twice; give each value once")
    return tuple(found)


def _range(name: str, first: str, end: str, step: str | None) -> list[str]:
    text = ":".join(each for each in (first, end, step) if each is not None)
    if len(text) > MOST_DIGITS:
        raise InputError(f"--grid: {name} has a range of {len(text)} characters; expected smaller numbers")
    if step is not None and int(step) == 0:
        raise InputError(f"--grid: {name}={text} has step 0; expected another")
    numbers = range(int(first), int(end), int(step or 1))
    if not numbers:
        raise InputError(f"--grid: {name}={text} is an empty range; its end is not part of it")
    if len(numbers) > MOST_JOBS:
        raise InputError(f"--grid: {name}={text} has {len(numbers):,} values; expected at most {MOST_JOBS:,}")
    return [str(number) for number in numbers]
