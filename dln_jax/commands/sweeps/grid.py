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
from typing import get_args, get_type_hints

from dln_jax.commands.sweeps.job import Job
from dln_jax.errors import InputError
from dln_jax.runs.arguments import arguments_for, pairs_of, parse
from dln_jax.runs.options import CompilationCache

RANGE = re.compile(r"(-?\d{1,18}):(-?\d{1,18})(?::(-?\d{1,18}))?")
NAME = re.compile(r"^(?:--)?([^=]*)")
"""An option's name at the start of a word, after hyphens that are left out."""
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
    return pairs_of(option, [NAME.sub(lambda name: name[1].replace("-", "_"), word) for word in words])


def grid_of(text: str) -> dict[str, tuple[str, ...]]:
    """Parses a grid: values by option, in the order of the text.

    Spaces separate options, commas separate values; `a:b` and `a:b:step` are whole numbers that exclude b. Quotes
    protect spaces, as in a shell.

    Raises:
        InputError: empty or malformed text, a repeated option or value, an empty range, more than 10,000 combinations.
    """
    grid: dict[str, tuple[str, ...]] = {}
    for name, listed in pairs("--grid", text).items():
        values: list[str] = []
        for part in listed.split(","):
            if not part:
                raise InputError(f"--grid: {name} has an empty value; leave the comma out")
            if not (numbers := RANGE.fullmatch(part)):
                values.append(part)
                continue
            start, stop, step = int(numbers[1]), int(numbers[2]), int(numbers[3] or 1)
            if step == 0:
                raise InputError(f"--grid: {name}={part} has step 0; expected another")
            if not (span := range(start, stop, step)):
                raise InputError(f"--grid: {name}={part} is an empty range; its end is not part of it")
            if len(span) > MOST_JOBS:
                raise InputError(f"--grid: {name}={part} has {len(span):,} values; expected at most {MOST_JOBS:,}")
            values += map(str, span)
        value, times = Counter(values).most_common(1)[0]
        if times > 1:
            raise InputError(f"--grid: {name} has {value} twice; give each value once")
        grid[name] = tuple(values)
    if not grid:
        raise InputError(f"--grid names no option; {EXAMPLE}")
    if (count := math.prod(map(len, grid.values()))) > MOST_JOBS:
        raise InputError(f"--grid has {count:,} combinations; expected at most {MOST_JOBS:,}; split it into several")
    return grid


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
    whole = arguments_for(arguments, {**fixed, **{name: texts[0] for name, texts in grid.items()}})
    hints = get_type_hints(whole)
    types = {field.name: hints[field.name] for field in dataclasses.fields(whole)} | {"compilation_cache": bool}
    if both := [name for name in grid if name in fixed]:
        raise InputError(f"{both[0]} is in --grid and in --fixed; leave it out of one")
    if "out" not in types:
        raise InputError(f"{command} has no --out, so that it leaves nothing to compare; choose a command that trains")

    def word(source: str, name: str, text: str) -> str:
        """The command-line word for an option's value."""
        option = name.replace("_", "-")
        if bool not in (types[name], *get_args(types[name])):
            return f"--{option}={text}"
        if text.lower() not in TRUTH:
            raise InputError(f"{source}: {name} is {text!r:.40}; expected yes or no")
        return f"--{option}" if TRUTH[text.lower()] else f"--no-{option}"

    words: dict[str, dict[str, str]] = {}
    for name, texts in {**{name: (text,) for name, text in fixed.items()}, **grid}.items():
        source = "--grid" if name in grid else "--fixed"
        if name in OF_SWEEPS:
            raise InputError(f"{source} has {name}, which every job gets from the sweep; leave it out")
        if name not in types:
            like = closest(name, list(types))
            raise InputError(f"{source}: {command} has no option {name}{like} (see {command} --help)")
        words[name] = {text: word(source, name, text) for text in texts}
    first = {name: next(iter(by_text.values())) for name, by_text in words.items()}
    prog = f"python -m dln_jax {command}"
    for name, texts in words.items():
        # Parsing takes milliseconds, so that one whole number is checked for all.
        for text in {"0" if text.isdecimal() and len(text) < 10 else text: text for text in texts}.values():
            line = [*(first | {name: texts[text]}).values()]
            try:
                parsed = parse(arguments, prog=prog, description=None, line=line, common=CompilationCache)
            except InputError as error:
                raise InputError(f"{'--grid' if name in grid else '--fixed'}: {error}") from None
            value = getattr(parsed.own, name, None)
            if isinstance(value, Path) and not value.exists():
                raise InputError(f"{'--grid' if name in grid else '--fixed'}: {name}={text}: no such file or folder")
    # Within an allocation of several tasks, a job would otherwise take itself for one process of a larger run.
    common = [first[name] for name in fixed] + ["--processes=1"] * ("processes" in types)
    jobs = []
    for number, texts in enumerate(itertools.product(*grid.values())):
        values = dict(zip(grid, texts, strict=True))
        line = (*common, *(words[name][text] for name, text in values.items()))
        jobs.append(Job(folder / "jobs" / f"{number:04}", command, line, values, "resume" in types, Path.cwd()))
    return jobs


def closest(word: str, known: Sequence[str]) -> str:
    """ "; did you mean WORD?" for the known word closest to an unknown one, or nothing."""
    like = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {like[0]}?" if like else ""
