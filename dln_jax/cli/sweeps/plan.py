"""From a grid to jobs; checks options and values against the command's own arguments before anything starts."""

import dataclasses
import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args, get_type_hints

from dln_jax.cli.arguments import parse
from dln_jax.cli.running import with_compilation_cache
from dln_jax.cli.sweeps.grid import combinations
from dln_jax.cli.sweeps.job import Job
from dln_jax.types import InputError

OF_SWEEPS = ("out", "resume", "processes", "coordinator", "process_id")
"""Options that the sweep sets for its jobs or that its jobs cannot use."""
TRUTH = {**dict.fromkeys(("yes", "true", "on"), True), **dict.fromkeys(("no", "false", "off"), False)}


def plan(
    command: str, arguments: type, grid: Mapping[str, Sequence[str]], fixed: Mapping[str, str], folder: Path
) -> list[Job]:
    """The jobs of a grid, in folders jobs/0000, jobs/0001, ... of `folder`.

    Args:
        command: name of the command.
        arguments: its dataclass of arguments.
        grid: values by option.
        fixed: values of the options common to all jobs.
        folder: folder of the sweep.

    Raises:
        InputError: an option that the command lacks or that the sweep sets itself, a value of the wrong type, or a
            missing file.
    """
    known = [*(field.name for field in dataclasses.fields(arguments)), "compilation_cache"]
    if both := [name for name in grid if name in fixed]:
        raise InputError(f"{both[0]} is in --grid and in --fixed; leave it out of one")
    if "out" not in known:
        raise InputError(f"{command} has no --out, so that it leaves nothing to compare; choose a command that trains")
    stated = [("--fixed", name, (text,)) for name, text in fixed.items()]
    stated += [("--grid", name, tuple(texts)) for name, texts in grid.items()]
    for where, name, _ in stated:
        if name in OF_SWEEPS:
            raise InputError(f"{where} has {name}, which every job gets from the sweep; leave it out")
        if name not in known:
            raise InputError(f"{where}: {command} has no option {name}{closest(name, known)} (see {command} --help)")
    words = {name: [_word(arguments, where, name, text) for text in texts] for where, name, texts in stated}
    first = {name: each[0] for name, each in words.items()}
    for where, name, texts in stated:
        for text, word in zip(texts, words[name], strict=True):
            if word != words[name][0] and not _differs_in_kind(text, texts[0]):
                continue  # parsing takes milliseconds; one whole number is checked for all
            try:
                value = getattr(_parsed(command, arguments, [*(first | {name: word}).values()]), name, None)
            except InputError as error:
                raise InputError(f"{where}: {error}") from None
            if isinstance(value, Path) and not value.exists():
                raise InputError(f"{where}: {name}={text}: no such file or folder")
    jobs = []
    # Within an allocation of several tasks, a job would otherwise take itself for one process of a larger run.
    alone = ("--processes=1",) if "processes" in known else ()
    by_text = {name: dict(zip(texts, words[name], strict=True)) for _, name, texts in stated}
    for number, values in enumerate(combinations(grid)):
        line = (*(words[name][0] for name in fixed), *alone, *(by_text[name][text] for name, text in values.items()))
        resumes = "resume" in known
        if hasattr(arguments, "continues"):
            resumes = _parsed(command, arguments, line).continues
        job = Job(folder / "jobs" / f"{number:04}", command, line, values, resumes, Path.cwd())
        jobs.append(job)
    return jobs


def closest(word: str, known: Sequence[str]) -> str:
    """ "; did you mean WORD?" for the known word closest to an unknown one, or nothing."""
    like = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


def _word(arguments: type, where: str, name: str, text: str) -> str:
    """The command-line word for an option's value; paths become absolute, so that jobs may run anywhere.

    Raises:
        InputError: an option that is yes or no has another value.
    """
    hint = get_type_hints(arguments).get(name, bool)
    option = name.replace("_", "-")
    if bool in (hint, *get_args(hint)):
        if text.lower() not in TRUTH:
            raise InputError(f"{where}: {name} is {text!r:.40}; expected yes or no")
        return f"--{option}" if TRUTH[text.lower()] else f"--no-{option}"
    return f"--{option}={Path(text).resolve() if Path in (hint, *get_args(hint)) else text}"


def _differs_in_kind(text: str, other: str) -> bool:
    return not all(each.removeprefix("-").isdecimal() and len(each) < 10 for each in (text, other))


def _parsed(command: str, arguments: type, line: Sequence[str]) -> Any:
    return parse(
        with_compilation_cache(arguments), prog=f"python -m dln_jax {command}", description=None, line=line
    ).own
