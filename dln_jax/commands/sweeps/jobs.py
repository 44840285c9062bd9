"""Jobs of a sweep: one for each combination of a grid such as `width=8,16 seed=0:10`.

Options and values are checked against the command's own arguments before anything starts. A job is a command in its
own process; a status file in its folder records how it ended.
"""

import dataclasses
import itertools
import math
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

from filelock import FileLock

from dln_jax.files import as_type, is_file, read_json, write_json
from dln_jax.options import CompilationCache
from dln_jax.runs.arguments import arguments_for, closest, pairs_of, parse
from dln_jax.runs.folder import CONFIG, LOCK
from dln_jax.runs.running import INTERRUPTED
from dln_jax.types import InputError

STATUS = "status.json"
OUTPUT = "output.txt"
"""Standard output and errors of the command."""
METRICS = "metrics.json"
"""File in the run's folder with the numbers to compare."""
SECONDS_BETWEEN_LOOKS = 0.1
SECONDS_TO_END = 10.0
"""Time for an interrupted command to store its last checkpoint before it is killed."""
_RUN = re.compile(r"run(-\d{1,9})?")
"""Names of the run folders that a job creates."""
RANGE = re.compile(r"(-?\d{1,18}):(-?\d{1,18})(?::(-?\d{1,18}))?")
NAME = re.compile(r"^(?:--)?([^=]*)")
"""An option's name at the start of a word, without leading hyphens."""
MOST_JOBS = 10_000
EXAMPLE = "expected for example 'width=8,16 seed=0:10'"
OF_SWEEPS = ("out", "resume", "processes", "coordinator", "process_id")
"""Options that the sweep sets for its jobs or that its jobs cannot use."""
TRUTH = {**dict.fromkeys(("yes", "true", "on"), True), **dict.fromkeys(("no", "false", "off"), False)}
State = Literal["missing", "running", "done", "failed", "killed"]


class Status(NamedTuple):
    """Progress of a job."""

    state: State = "missing"
    line: str = ""
    """Reason if the job is not done: the command's error message, or the signal that ended it."""
    attempt: int = 0
    run: str = "run"
    """Name of the run's folder within the job's folder."""
    seconds: float | None = None
    """Duration of the last attempt."""


class Job(NamedTuple):
    """One run of a command."""

    folder: Path
    command: str
    arguments: tuple[str, ...]
    """Arguments of the command line, without --out and --resume."""
    values: Mapping[str, str]
    """Grid values by option, as typed."""
    resumes: bool
    """Whether the command can continue an interrupted run."""
    directory: Path
    """Working directory of the command."""

    def line(self, run: Path) -> list[str]:
        """Returns the command line that writes the job's run into this folder."""
        return [sys.executable, "-m", "dln_jax", self.command, *self.arguments, f"--out={run}"]


def run_job(job: Job, environment: Mapping[str, str] | None = None, interrupt: threading.Event | None = None) -> None:
    """Runs a job's command and stores its status; any executor may call this in a process that sees the job's folder.

    A finished job is not repeated. An interrupted one continues with --resume if its command supports that, else it
    starts again in another folder. If two processes call the same job, the second waits for the first.

    Args:
        environment: environment variables of the command; default: those of this process.
        interrupt: ends the command when it is set.
    """
    interrupt = interrupt or threading.Event()
    job.folder.mkdir(parents=True, exist_ok=True)
    with FileLock(job.folder / LOCK):
        before = status_of(job.folder)
        if before.state == "done":
            return
        attempt, run = before.attempt + 1, job.folder / before.run
        resume = job.resumes and (run / CONFIG).is_file()
        if run.exists() and not resume:
            run = job.folder / f"run-{attempt}"
        status = Status("running", attempt=attempt, run=run.name)
        write_json(job.folder / STATUS, status._asdict())
        began = time.monotonic()
        with (job.folder / OUTPUT).open("ab") as output:
            first = output.tell()
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            line = [*job.line(run), *["--resume"] * resume]
            process = subprocess.Popen(line, cwd=job.directory, env=environment and dict(environment), **streams)
            try:
                while process.poll() is None and not interrupt.wait(SECONDS_BETWEEN_LOOKS):
                    pass
            finally:
                process.terminate()  # our commands treat it as Ctrl-C; a background process would ignore Ctrl-C itself
                try:
                    process.wait(SECONDS_TO_END)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
        state, reason = _outcome(process.returncode, job.folder / OUTPUT, first)
        status = status._replace(state=state, line=reason, seconds=time.monotonic() - began)
        write_json(job.folder / STATUS, status._asdict())


def status_of(folder: Path) -> Status:
    """Reads the status of the job in a folder. A job run by other means counts as done if its metrics exist.

    Raises:
        InputError: the status file is damaged, or names a run that is not in the job's folder.
    """
    path, remedy = folder / STATUS, "remove it, and --resume does the job again"
    if not is_file(path):
        return Status("done" if is_file(folder / "run" / METRICS) else "missing")
    stored = read_json(path, remedy=remedy)
    values = [stored.get(name, default) for name, default in Status._field_defaults.items()]
    status = as_type(values, Status, name=str(path), remedy=remedy)
    if status.attempt < 0 or not _RUN.fullmatch(status.run) or (folder / status.run).is_symlink():
        raise InputError(f"{path}: attempt {status.attempt}, run '{status.run:.60}' are not those of a job; {remedy}")
    if status.state == "done" and not any((folder / status.run).glob("*")):
        return Status(line="its run folder is missing", attempt=status.attempt)
    return status


def _outcome(code: int, output: Path, first: int) -> tuple[State, str]:
    """State and reason of a job, from its exit status and its output after the byte `first`."""
    if code == 0:
        return "done", ""
    if code in (INTERRUPTED, -signal.SIGINT, -signal.SIGTERM):
        return "killed", "interrupted"
    if code < 0:
        return "killed", f"ended by {signal.Signals(-code).name}"
    text = output.read_bytes()[first:].decode(errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return "failed", (errors or lines or [""])[-1].removeprefix("error: ")[:300]


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
        raise InputError(f"{both[0]} is in both --grid and --fixed; leave it out of one")
    if "out" not in types:
        raise InputError(f"{command} has no --out and leaves nothing to compare; choose a command that trains")

    def word(source: str, name: str, text: str) -> str:
        """The command-line word for an option's value."""
        option = name.replace("_", "-")
        if bool not in (types[name], *get_args(types[name])):
            return f"--{option}={text}"
        if text.lower() not in TRUTH:
            raise InputError(f"{source}: {name} is {text!r:.40}; expected yes or no")
        return f"--{option}" if TRUTH[text.lower()] else f"--no-{option}"

    words: dict[str, dict[str, str]] = {}
    prog = f"dln-jax {command}"
    for name, texts in {**{name: (text,) for name, text in fixed.items()}, **grid}.items():
        source = "--grid" if name in grid else "--fixed"
        if name in OF_SWEEPS:
            raise InputError(f"{source} has {name}, which every job gets from the sweep; leave it out")
        if name not in types:
            raise InputError(
                f"{source}: {command} has no option {name}{closest(name, list(types))} (see {prog} --help)"
            )
        words[name] = {text: word(source, name, text) for text in texts}
    first = {name: next(iter(by_text.values())) for name, by_text in words.items()}
    for name, texts in words.items():
        # Parsing takes milliseconds, so that one whole number is checked for all.
        for text in {"0" if text.isdecimal() and len(text) < 10 else text: text for text in texts}.values():
            line = [*(first | {name: texts[text]}).values()]
            try:
                own, _ = parse(arguments, prog=prog, description=None, line=line, common=CompilationCache)
            except InputError as error:
                raise InputError(f"{'--grid' if name in grid else '--fixed'}: {error}") from None
            value = getattr(own, name, None)
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
