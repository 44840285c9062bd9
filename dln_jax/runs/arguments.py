"""Typed command lines: options that belong to a choice, help texts, and mistakes reported in one line."""

import dataclasses
import difflib
import itertools
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, get_args

import tyro
from tyro._errors import BadValue, InstantiationFailure, InvalidChoice, ParseErrorEvent, on_parse_error
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from dln_jax.errors import InputError, require_magnitude
from dln_jax.options import Checked, Filtered, Logged
from dln_jax.runs.help import help_text

if TYPE_CHECKING:
    from dln_jax.types import Needs

_rules = ConstructorRegistry()


@_rules.primitive_rule
def _number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Reads int and float, with error messages in the style of all others."""
    kind, wanted = info.type, {int: "a whole number", float: "a number"}.get(info.type)
    if wanted is None:
        return None

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            few = " of fewer than 4,300 digits" * words[0].isdecimal()
            raise ValueError(f"must be {wanted}{few}; got {words[0]!r:.60}") from None

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=read,
        is_instance=lambda value: isinstance(value, int | kind) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


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


class Variants(NamedTuple):
    """Options that exist only for some choices of a command, such as one model: its attribute `VARIANTS`."""

    chosen: Callable[[Mapping[str, Any]], type]
    """Options that were typed or stored, by name -> the dataclass of all options for these choices."""
    known: Mapping[type, str]
    """For each of these dataclasses, a description of the options that choose it."""


def arguments_for(arguments: type, stated: Mapping[str, Any]) -> type:
    """Returns the dataclass of a command's options for its choices; `stated` are the options typed or stored."""
    variants: Variants | None = getattr(arguments, "VARIANTS", None)
    return arguments if variants is None else variants.chosen(stated)


def arguments_of(arguments: type, **stated: Any) -> Any:
    """A command's options as Python values, as typed on its command line.

    Raises:
        InputError: an option that the command does not read for these choices.
    """
    whole = arguments_for(arguments, stated)
    _refuse_unknown(stated, (whole,), arguments)
    return whole(**stated)


def parse(arguments: type, *, prog: str, description: str | None, line: Sequence[str], common: type) -> tuple[Any, Any]:
    """Parses a command line into the command's own and the common options.

    `--help` and `--help-all` print the help and exit.

    Args:
        prog: the command as the user typed it.
        common: dataclass of options that every command has.

    Raises:
        InputError: the line cannot be parsed.
    """
    typed = _typed(line)
    whole = arguments_for(arguments, typed)
    if "help" in typed or "help_all" in typed or "-h" in line:
        print(help_text(whole, prog=prog, description=description or "", common=common, every="help_all" in typed))
        raise SystemExit(0)

    see = f" (see {prog} --help)"
    _refuse_unknown(typed, (whole, common), arguments, see)

    def refuse(event: ParseErrorEvent) -> None:
        raise InputError(_complaint(event, arguments) + see)

    unnamed = tyro.conf.arg(name="")
    both: Any = tuple[Annotated[whole, unnamed], Annotated[common, unnamed]]
    with on_parse_error(refuse):
        return tyro.cli(both, prog=prog, description=description, args=line, registry=_rules)


def _typed(line: Sequence[str]) -> dict[str, Any]:
    """Returns the options on a command line with their text; options without a value are `True`."""
    typed: dict[str, Any] = {}
    for word, following in itertools.pairwise([*line, "--"]):
        if word.startswith("--"):
            option, equals, text = word[2:].partition("=")
            typed[option.replace("-", "_")] = text if equals else following if following[:2] != "--" else True
    return typed


def _complaint(event: ParseErrorEvent, arguments: type) -> str:
    """One line about a word that could not be parsed."""
    argument = getattr(event, "argument", None)
    option = argument.lowered.name_or_flags[-1] if argument is not None else ""
    match event:
        case InvalidChoice():
            return f"{option} is {event.value!r:.60}; choose from {', '.join(event.choices)}"
        case InstantiationFailure():
            return f"{option} {event.message}"
        case BadValue():
            return f"{option} lacks a value" if event.offending_value is None else f"{option} takes no value"
    if tokens := getattr(event, "tokens", []):
        return _unknown(tokens[0], arguments)
    missing = [context.arg.lowered.name_or_flags[-1] for context in getattr(event, "missing_arguments", [])]
    return f"{', '.join(missing)} must be given" if missing else "the options contradict each other"


def _refuse_unknown(stated: Iterable[str], kinds: Iterable[type], arguments: type, see: str = "") -> None:
    """Raises `InputError` for the first name that is no option of these classes."""
    names = {field.name for kind in kinds for field in dataclasses.fields(kind)}
    for name in stated:
        if name.removeprefix("no_") not in names:
            raise InputError(_unknown(f"--{name.replace('_', '-')}", arguments) + see)


def _unknown(option: str, arguments: type) -> str:
    """Message on an option that is unknown, or that exists only for other choices of the command."""
    name, known = option.lstrip("-").partition("=")[0].replace("-", "_"), {}
    if (variants := getattr(arguments, "VARIANTS", None)) is not None:
        known = variants.known
    for negated in (name, name.removeprefix("no_")):
        for kind, words in known.items():
            if option[:2] == "--" and negated in {field.name for field in dataclasses.fields(kind)}:
                return f"{option} is an option of {words}; add that, or leave {option} out"
    names = [f"--{field.name.replace('_', '-')}" for kind in (arguments, *known) for field in dataclasses.fields(kind)]
    return f"unrecognised option: {option:.80}{closest(option, [*names, *(f'--no{name[1:]}' for name in names)])}"


def closest(word: str, known: Sequence[str]) -> str:
    """Returns "; did you mean WORD?" for the known word closest to a misspelt one, or nothing."""
    like = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


def names_listed(text: str | None) -> tuple[str, ...]:
    """Splits the comma-separated names of an option such as --lock; empty if the option was not set."""
    return tuple(stripped for name in (text or "").split(",") if (stripped := name.strip()))


def refuse_given(options: Any, names: Iterable[str], why: str) -> None:
    """Raises `InputError` for the first of these options that was set."""
    for name in names:
        if getattr(options, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is {why}; leave it out")


def require_positive_if_given(options: Any, names: Iterable[str]) -> None:
    """Raises `InputError` for the first of these options that is set but not positive."""
    for name in names:
        value = getattr(options, name, None)
        if value is not None and not value > 0:
            raise InputError(f"{name} is {value}; expected a positive number")


def resolved(options: Any, defaults: Mapping[str, Any]) -> dict[str, Any]:
    """The options named in `defaults`, with unset ones replaced by their defaults."""
    stated = {name: getattr(options, name) for name in defaults}
    return {name: defaults[name] if value is None else value for name, value in stated.items()}


def names_in(option: str, text: str, known: Iterable[str]) -> list[str]:
    """Splits a comma-separated list of names; `InputError` lists the known names if one is unknown or none is named."""
    names = list(names_listed(text))
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"{option}: '{unknown[0]}' is unknown; choose from {', '.join(known)}")
    if not names:
        raise InputError(f"{option} names nothing; choose from {', '.join(known)}")
    return names


def pairs_of(option: str, words: Iterable[str]) -> dict[str, str]:
    """Splits words NAME=VALUE; `InputError` for other words and for repeated names."""
    values: dict[str, str] = {}
    for word in words:
        name, _, value = (part.strip() for part in word.partition("="))
        if not (name and value):
            raise InputError(f"{option} has {word!r:.60}; expected NAME=VALUE")
        if name in values:
            raise InputError(f"{option} names '{name:.60}' twice; give it once")
        values[name] = value
    return values


def numbers_of(option: str, text: str, counts: Collection[int] = (), *, positive: bool = False) -> tuple[float, ...]:
    """Parses the comma-separated numbers of an option.

    Args:
        option: name, such as --noise.
        counts: allowed counts of numbers (default: any).

    Raises:
        InputError: wrong count, text that is not a number, or a number out of range.
    """
    try:
        numbers = tuple(map(float, text.split(",")))
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


def facts(options: Logged) -> dict[str, Any]:
    """Keywords of `data.log.read_log`: facts about a file, and how to filter and check it."""
    names = {"joints": names_listed(options.joints), "topics": names_listed(options.topics)}
    factor = None if options.torque_factor is None else torque_factor(options.torque_factor)
    stated = {"rate": options.rate, "units": options.units, "torque_factor": factor, **names}
    if isinstance(options, Checked):
        stated["accept_log"] = options.accept_log
    if isinstance(options, Filtered):
        stated["cutoff"] = cutoff(options.cutoff)
    return stated


def torque_factor(text: str) -> float | tuple[float, ...] | dict[str, float]:
    """Parses --torque-factor: a number, one for each joint, or NAME=NUMBER."""
    option = "--torque-factor"
    if "=" in text:
        pairs = pairs_of(option, text.split(","))
        return {name: numbers_of(f"{option} {name}", factor, [1])[0] for name, factor in pairs.items()}
    numbers = numbers_of(option, text)
    return numbers[0] if len(numbers) == 1 else numbers


def cutoff(text: str | None) -> Any:
    """Parses --cutoff: Hz, auto, or inf."""
    if text in (None, "auto"):
        return text
    try:
        value = float(str(text))
    except ValueError:
        value = -1.0
    if not value > 0:
        raise InputError(f"--cutoff is {text!r:.40}; expected Hz, a positive number, or auto (inf: no filter)")
    return value


def needs_of(text: str | None) -> "Needs | None":
    """Parses --needs: JSON, or in short a letter for each joint and its terms, such as "rp friction no-gravity".

    Raises:
        InputError: the text does not state valid needs.
    """
    from dln_jax.data.joints import needs_from_json, needs_from_text  # imports JAX

    try:
        if text is None or text.lstrip()[:1] in ("{", "["):
            return None if text is None else needs_from_text(text)
        kinds, *terms = text.split() or [""]
        if not re.fullmatch("[rp]+", kinds):
            raise InputError(f"needs: {text!r:.40} is neither a letter r or p for each joint with its terms, nor JSON")
        laws = [term for term in terms if term not in ("friction", "no-gravity")]
        stated: dict[str, Any] = {"joints": [{"r": "revolute", "p": "prismatic"}[letter] for letter in kinds]}
        return needs_from_json(
            stated | {"friction": "friction" in terms, "gravity": "no-gravity" not in terms, "joint_friction": laws}
        )
    except InputError as error:
        raise InputError(f"--{error}; see --help for an example") from None
