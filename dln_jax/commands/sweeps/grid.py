"""Turns the text of a grid, such as `width=8,16 seed=0:10`, into jobs, one for each combination of the values.

Options and values are checked against the command's own arguments before anything starts.
"""

import dataclasses
import difflib
import itertools
import math
import re
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from dln_jax.commands.sweeps.job import Job
from dln_jax.errors import InputError
from dln_jax.runs.arguments import arguments_for, parse
from dln_jax.runs.options import CompilationCache

RANGE = re.compile(r"(-?\d{1,18}):(-?\d{1,18})(?::(-?\d{1,18}))?")
MOST_JOBS = 10_000
EXAMPLE = "expected for example 'width=8,16 seed=0:10'"
OF_SWEEPS = ("out", "resume", "processes", "coordinator", "process_id")
"""Options that the sweep sets for its jobs or that its jobs cannot use."""
TRUTH = {**dict.fromkeys(("yes", "true", "on"), True), **dict.fromkeys(("no", "false", "off"), False)}


def pairs(option: str, text: str) -> dict[str, str]:
    """Splits an option's text into NAME=VALUE pairs; `InputError` for other words and for repeated names."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"{option} is {text!r:.60}: {str(error).lower()}; close the quotes") from None
    values: dict[str, str] = {}
    for word in words:
        name, equals, value = word.partition("=")
        name = name.removeprefix("--").replace("-", "_")
        if not equals or not name.isidentifier() or not value:
            raise InputError(f"{option} has {word!r:.60}, which is no NAME=VALUE; {EXAMPLE}")
        if name in values:
            raise InputError(f"{option} names {name} twice; give all its values at once")
        values[name] = value
    return values


def grid_of(text: str) -> dict[str, tuple[str, ...]]:
    """Parses a grid: values by option, in the order of the text.

    Spaces separate options, commas separate values; `a:b` and `a:b:step` are whole numbers that exclude b. Quotes
    protect spaces, as in a shell.

    Raises:
        InputError: empty or malformed text, a repeated option or value, an empty range, more than 10,000 combinations.
    """
    parts = {
        name: [_values(name, part) for part in values.split(",")] for name, values in pairs("--grid", text).items()
    }
    if not parts:
        raise InputError(f"--grid names no option; {EXAMPLE}")
    # Counted before the ranges are written out, which could exhaust the memory.
    if (count := math.prod(sum(map(len, values)) for values in parts.values())) > MOST_JOBS:
        raise InputError(f"--grid has {count:,} combinations; expected at most {MOST_JOBS:,}; split it into several")
    grid = {name: tuple(map(str, itertools.chain(*values))) for name, values in parts.items()}
    for name, values in grid.items():
        value, times = Counter(values).most_common(1)[0]
        if times > 1:
            raise InputError(f"--grid: {name} has {value} twice; give each value once")
    return grid


def _values(name: str, text: str) -> Sequence[str | int]:
    """One part of an option's values: a word, or a range of whole numbers."""
    if not text:
        raise InputError(f"--grid: {name} has an empty value; leave the comma out")
    if not (parts := RANGE.fullmatch(text)):
        return [text]
    start, stop, step = int(parts[1]), int(parts[2]), int(parts[3] or 1)
    if step == 0:
        raise InputError(f"--grid: {name}={text} has step 0; expected another")
    if not (numbers := range(start, stop, step)):
        raise InputError(f"--grid: {name}={text} is an empty range; its end is not part of it")
    return numbers


def jobs_of(
    command: str, arguments: type, grid: Mapping[str, Sequence[str]], fixed: Mapping[str, str], folder: Path
) -> list[Job]:
    """The jobs of a grid, in folders jobs/0000, jobs/0001, ... of `folder`; the last option changes fastest.

    Args:
        fixed: values of the options common to all jobs.

    Raises:
        InputError: an option that the command lacks or the sweep sets itself, a wrong value, or a missing file.
    """
    # Options that only some choices read, such as a model's, are those of the first job.
    stated = {**fixed, **{name: texts[0] for name, texts in grid.items()}}
    whole = arguments_for(arguments, stated)
    known = [*(field.name for field in dataclasses.fields(whole)), "compilation_cache"]
    if both := [name for name in grid if name in fixed]:
        raise InputError(f"{both[0]} is in --grid and in --fixed; leave it out of one")
    if "out" not in known:
        raise InputError(f"{command} has no --out, so that it leaves nothing to compare; choose a command that trains")
    options = {name: ("--fixed", (text,)) for name, text in fixed.items()}
    options |= {name: ("--grid", tuple(texts)) for name, texts in grid.items()}
    words: dict[str, dict[str, str]] = {}
    for name, (source, texts) in options.items():
        if name in OF_SWEEPS:
            raise InputError(f"{source} has {name}, which every job gets from the sweep; leave it out")
        if name not in known:
            raise InputError(f"{source}: {command} has no option {name}{closest(name, known)} (see {command} --help)")
        words[name] = {text: _word(whole, source, name, text) for text in texts}
    first = {name: next(iter(by_text.values())) for name, by_text in words.items()}
    prog = f"python -m dln_jax {command}"
    for name, (source, texts) in options.items():
        # Parsing takes milliseconds, so that one whole number is checked for all.
        for text in {"0" if text.isdecimal() and len(text) < 10 else text: text for text in texts}.values():
            line = [*(first | {name: words[name][text]}).values()]
            try:
                parsed = parse(arguments, prog=prog, description=None, line=line, common=CompilationCache)
            except InputError as error:
                raise InputError(f"{source}: {error}") from None
            value = getattr(parsed.own, name, None)
            if isinstance(value, Path) and not value.exists():
                raise InputError(f"{source}: {name}={text}: no such file or folder")
    # Within an allocation of several tasks, a job would otherwise take itself for one process of a larger run.
    common = [first[name] for name in fixed] + ["--processes=1"] * ("processes" in known)
    jobs = []
    for number, texts in enumerate(itertools.product(*grid.values())):
        values = dict(zip(grid, texts, strict=True))
        line = (*common, *(words[name][text] for name, text in values.items()))
        jobs.append(Job(folder / "jobs" / f"{number:04}", command, line, values, "resume" in known, Path.cwd()))
    return jobs


def closest(word: str, known: Sequence[str]) -> str:
    """ "; did you mean WORD?" for the known word closest to an unknown one, or nothing."""
    like = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


def _word(arguments: type, source: str, name: str, text: str) -> str:
    """The command-line word for an option's value; paths become absolute, so that jobs may run anywhere."""
    hint: Any = get_type_hints(arguments).get(name, bool)
    option = name.replace("_", "-")
    if bool in (hint, *get_args(hint)):
        if text.lower() not in TRUTH:
            raise InputError(f"{source}: {name} is {text!r:.40}; expected yes or no")
        return f"--{option}" if TRUTH[text.lower()] else f"--no-{option}"
    return f"--{option}={Path(text).resolve() if Path in (hint, *get_args(hint)) else text}"
