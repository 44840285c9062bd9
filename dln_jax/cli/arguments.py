"""Typed command lines: help texts, and mistakes reported in one line."""

import contextlib
import dataclasses
import inspect
import io
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from types import NoneType
from typing import Annotated, Any, TypeVar, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from dln_jax.sizes import require_magnitude
from dln_jax.types import InputError, require_positive

T = TypeVar("T")
Arguments = TypeVar("Arguments")

Unstated = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
"""An option that is `None` by default; its help text states the effective default."""

UNREADABLE = {
    r"Error parsing (--\S+): invalid literal for int\(\) with base 10: (.*)": "a whole number",
    r"Error parsing (--\S+): Exceeds the limit \(\d+ digits\)()[^']*": "a whole number of fewer than 4,300 digits",
    r"Error parsing (--\S+): could not convert string to float: (.*)": "a number",
}
"""Python's conversion errors (groups: the option and its text), and the value that the option expects."""

_rules = ConstructorRegistry()


@_rules.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Shows `X | None` as X: nobody types None."""
    members = [member for member in get_args(info.type) if member is not NoneType]
    if len(members) != 1 or NoneType not in get_args(info.type):
        return None
    of_value = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(members[0], info.markers))
    if not isinstance(of_value, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        of_value,
        is_instance=lambda value: value is None or of_value.is_instance(value),
        str_from_instance=lambda value: ["none"] if value is None else of_value.str_from_instance(value),
    )


def choice(names: Iterable[str], *, several: bool = False, unstated: bool = False) -> Any:
    """Shows the allowed names of an option in its help, for `Annotated[str, ...]`.

    With `several` the option takes a list of names, by default all. With `unstated` the default is not shown, as for
    `Unstated`.
    """
    return tyro.conf.arg(
        metavar="{" + ",".join(names) + "}" + "[,...]" * several, help_behavior_hint="" if several or unstated else None
    )


def parse(
    arguments: type[Arguments], *, prog: str, description: str | None, line: Sequence[str] | None = None
) -> Arguments:
    """Parses a command line, by default that of this process; `--help` prints the help and exits.

    Raises:
        InputError: the line cannot be parsed.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(arguments, prog=prog, description=description, args=line, registry=_rules)
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(f"{_complaint(said.getvalue())} (see {prog} --help)") from None


def own_first(arguments: type[Arguments]) -> type[Arguments]:
    """Reorders a dataclass's fields for the help: its own first (a dataclass puts inherited fields first)."""
    fields = arguments.__dataclass_fields__  # type: ignore[attr-defined]
    names = [name for base in arguments.__mro__ for name in inspect.get_annotations(base) if name in fields]
    arguments.__dataclass_fields__ = {name: fields[name] for name in names}  # type: ignore[attr-defined]
    return arguments


def names_listed(text: str | None) -> tuple[str, ...]:
    """Splits the comma-separated names of an option such as --hold; empty if the option was not set."""
    return tuple(name for each in (text or "").split(",") if (name := each.strip()))


def refuse_given(given: Any, names: Iterable[str], why: str) -> None:
    """Raises `InputError` for the first of these options that was set, for example "--batch is for adam: ..."."""
    for name in names:
        if getattr(given, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is {why}; leave it out")


def require_positive_if_given(given: Any, names: Iterable[str]) -> None:
    """Raises `InputError` for the first of these options that is set but not positive."""
    require_positive(**{name: getattr(given, name) for name in names if getattr(given, name) is not None})


def resolved(given: Any, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The options named in `defaults`, with unset ones replaced by their defaults."""
    stated = {name: getattr(given, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in stated.items()}


def names_in(option: str, given: str, known: Iterable[str]) -> list[str]:
    """Splits a comma-separated list of names; `InputError` lists the known names if one is unknown or none is named."""
    names = [name.strip() for name in given.split(",") if name.strip()]
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"{option}: '{unknown[0]}' is unknown; choose from {', '.join(known)}")
    if not names:
        raise InputError(f"{option} names nothing; choose from {', '.join(known)}")
    return names


def _complaint(box: str) -> str:
    """Extracts the error from tyro's text box as one line: the first section below the title.

    A rule separates the title from the section where the box is drawn in ASCII.
    """
    framed = "│" in box
    lines = [line.strip("│ ") for line in box.splitlines() if line[:1] not in ("╭", "╰")]
    sections = re.split(r"\n[─-]{4,}\n", "\n".join(lines))
    section = sections[0] if framed else sections[min(1, len(sections) - 1)]
    said = " ".join(section.split()).rstrip(".")
    for pattern, wanted in UNREADABLE.items():
        if found := re.fullmatch(pattern, said):
            return f"{found[1]} must be {wanted}" + (f"; got {found[2]:.60}" if found[2] else "")
    return said


def numbers_of(option: str, text: str, counts: Collection[int] = (), *, positive: bool = False) -> tuple[float, ...]:
    """Parses the comma-separated numbers of an option.

    Args:
        option: name, such as --noise.
        text: text as typed.
        counts: allowed counts of numbers (default: any).
        positive: whether all numbers must be positive.

    Raises:
        InputError: wrong count, text that is not a number, or a number out of range.
    """
    try:
        numbers = tuple(float(each) for each in text.split(","))
    except ValueError:
        numbers = ()
    right = numbers and (not counts or len(numbers) in counts) and all(map(math.isfinite, numbers))
    if not right or (positive and min(numbers) <= 0):
        many = " or ".join(map(str, sorted(set(counts)))) or "finite"
        kind = "positive numbers" if positive else "numbers"
        raise InputError(f"{option} is {text!r:.60}; expected {many} {kind}, separated by commas")
    for number in numbers:
        require_magnitude(option, number)
    return numbers
