"""From a grid to jobs: options and values checked against the command's own arguments before anything starts."""

import dataclasses
import difflib
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

from dln_jax.command_line.arguments import parse
from dln_jax.command_line.running import with_compilation_cache
from dln_jax.files import is_file, read_json, write_json
from dln_jax.sweeps.grid import combinations
from dln_jax.types import InputError

OF_SWEEPS = ("out", "resume", "processes", "coordinator", "process_id")
"""Options of commands that every job gets from the sweep, or cannot have."""
TRUTH = {**dict.fromkeys(("yes", "true", "on"), True), **dict.fromkeys(("no", "false", "off"), False)}
JOB = "job.json"
"""File in a job's folder that says what it is, in JSON."""


class Job(NamedTuple):
    """One run of the command."""

    folder: Path
    values: dict[str, str]
    """Of the grid, as they were typed."""
    arguments: tuple[str, ...]
    """Of the command's line, without --out and --resume."""
    resumes: bool
    """Whether the command can continue what was interrupted."""

    @property
    def path(self) -> Path:
        """Of its file."""
        return self.folder / JOB


class Target(NamedTuple):
    """What every job runs."""

    command: str
    arguments: type
    """Its dataclass of arguments."""
    stated: Mapping[str, str]
    """A value of each option that is given, as it was typed."""


def plan(
    command: str,
    arguments: type,
    grid: Mapping[str, Sequence[str]],
    fixed: Mapping[str, str],
    folder: Path,
) -> list[Job]:
    """The jobs of a grid, in folders 0000, 0001, ... below `folder`.

    Args:
        command: name of the command.
        arguments: its dataclass of arguments.
        grid: values by option.
        fixed: values of the options that all jobs have.
        folder: of the sweep.

    Raises:
        InputError: an option that the command does not have or that is the sweep's, a value of another type, a file
            that does not exist.
    """
    if both := [name for name in grid if name in fixed]:
        raise InputError(f"{both[0]} is in --grid and in --fixed; leave it out of one")
    if "out" not in _options(arguments):
        raise InputError(f"{command} has no --out, so that it leaves nothing to compare; choose a command that trains")
    target = Target(command, arguments, {**{name: texts[0] for name, texts in grid.items()}, **fixed})
    common = [word for name, text in fixed.items() for word in _words(target, "--fixed", name, [text])]
    # Within an allocation of several tasks each of them would take itself for a part of one run.
    common += ["--processes=1"] * ("processes" in _options(arguments))
    words = {name: dict(zip(texts, _words(target, "--grid", name, texts), strict=True)) for name, texts in grid.items()}
    jobs = []
    for number, values in enumerate(combinations(grid)):
        line = (*common, *(words[name][text] for name, text in values.items()))
        jobs.append(Job(folder / "jobs" / f"{number:04}", values, line, _resumes(target, line)))
    return jobs


def write_jobs(jobs: Sequence[Job], command: str) -> None:
    """Writes the file of each job, from which it can be run anywhere that sees its folder.

    Raises:
        InputError: a file is there that says something else, or cannot be written.
    """
    here = str(Path.cwd())
    for job in jobs:
        said = {"command": command, "arguments": list(job.arguments), "values": job.values, "resumes": job.resumes}
        if is_file(job.path):
            stored = read_job(job.path)
            if any(stored[key] != said[key] for key in ("command", "arguments", "values")):
                raise InputError(f"{job.path} is of another job; continue where the sweep was started, or remove it")
            continue
        job.folder.mkdir(parents=True, exist_ok=True)
        write_json(job.path, {**said, "folder": here})


def read_job(path: Path) -> dict[str, Any]:
    """What a job's file says.

    Raises:
        InputError: the file is missing or damaged, or names no command.
    """
    remedy = "remove the folder of this job, and --resume the sweep"
    job = read_json(path, remedy=remedy)
    kinds = {"command": str, "arguments": list, "values": dict, "resumes": bool, "folder": str}
    for name, kind in kinds.items():
        if type(job.get(name)) is not kind:
            raise InputError(f"{path}: {name} is {reprlib.repr(job.get(name))}; expected a {kind.__name__}; {remedy}")
    words = [*job["arguments"], *job["values"].values()]
    if not all(isinstance(word, str) for word in words) or not job["command"].isidentifier():
        raise InputError(f"{path}: command and arguments are not words; {remedy}")
    if not Path(job["folder"]).is_dir():
        raise InputError(f"{path}: the sweep was started in {job['folder']:.200}, which is gone; start it again")
    return job


def closest(word: str, known: Sequence[str]) -> str:
    """ "; did you mean WORD?" for the word that is most like a wrong one, or nothing."""
    like = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {like[0]}?" if like else ""


def _options(arguments: type) -> list[str]:
    return [*(field.name for field in dataclasses.fields(arguments)), "compilation_cache"]


def _words(target: Target, where: str, name: str, texts: Sequence[str]) -> list[str]:
    """The word of a command line for each value of an option."""
    known = _options(target.arguments)
    if name in OF_SWEEPS:
        raise InputError(f"{where} has {name}, which every job gets from the sweep; leave it out")
    if name not in known:
        like = closest(name, known)
        raise InputError(f"{where}: {target.command} has no option {name}{like} (see {target.command} --help)")
    hint = get_type_hints(target.arguments).get(name, bool)
    kinds = (hint, *get_args(hint))
    option = name.replace("_", "-")
    if bool in kinds:
        if wrong := [text for text in texts if text.lower() not in TRUTH]:
            raise InputError(f"{where}: {name} is {wrong[0]!r:.40}; expected yes or no")
        return [f"--{option}" if TRUTH[text.lower()] else f"--no-{option}" for text in texts]
    words = [f"--{option}={text}" for text in texts]
    # All whole numbers are of the type that one is of.
    alike = (int in kinds or float in kinds) and all(
        text.removeprefix("-").isdecimal() and len(text) < 10 for text in texts
    )
    for index in range(1 if alike else len(texts)):
        try:
            value = getattr(_parsed(target, [*_required(target, name), words[index]]), name)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        if isinstance(value, Path):
            if not value.exists():
                raise InputError(f"{where}: {name}={texts[index]}: no such file or folder")
            words[index] = f"--{option}={value.resolve()}"
    return words


def _required(target: Target, but: str) -> list[str]:
    """Words for the options without a default, as far as they are given, without one option."""
    missing = dataclasses.MISSING
    fields = [
        field for field in dataclasses.fields(target.arguments) if field.default is field.default_factory is missing
    ]
    names = [field.name for field in fields if field.name in target.stated and field.name != but]
    return [f"--{name.replace('_', '-')}={target.stated[name]}" for name in names]


def _parsed(target: Target, line: Sequence[str]) -> Any:
    whole = with_compilation_cache(target.arguments)
    return parse(whole, prog=f"python -m dln_jax {target.command}", description=None, line=line).own


def _resumes(target: Target, line: Sequence[str]) -> bool:
    # To parse a line takes milliseconds: only where its values decide.
    if not hasattr(target.arguments, "continues"):
        return "resume" in _options(target.arguments)
    return _parsed(target, line).continues
