"""Shared parts of the command lines: one-line errors, scene names, and run folders."""

import contextlib
import dataclasses
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import jax
import tyro

from dln_jax.cli import compilation_cache
from dln_jax.cli.arguments import choice, own_first, parse
from dln_jax.cli.scaled import (
    copied_folder,
    end_at_once,
    is_first,
    joined,
    membership_in,
    remedy_of,
    wait_for_all,
)
from dln_jax.cli.stored_arguments import with_stored_arguments, write_config
from dln_jax.data.stated_needs import needs_from_text
from dln_jax.metrics.verdict import FitRefused
from dln_jax.scale.devices import unusable_platform
from dln_jax.scale.processes import JOINING, ProcessLost, losses_named
from dln_jax.scenes.registry import SCENES
from dln_jax.sizes import require_magnitude, require_within
from dln_jax.time_limit import IMPORTED, counting_from
from dln_jax.types import InputError, Needs, require_seed
from dln_jax.zoo.run_folder import CONFIG, run_folder

MOST_CHARACTERS = 400
"""Characters shown at either end of a long message; the middle is left out."""
SceneName = Annotated[str, choice(SCENES)]

Arguments = TypeVar("Arguments")


def run(
    main: Callable[[Arguments], None],
    arguments: type[Arguments],
    *,
    prog: str,
    from_shell: bool = False,
    joining: int = JOINING,
) -> None:
    """Parses the command line and runs `main`; errors and exit statuses as `as_one_line`.

    Args:
        main: body of the command.
        arguments: dataclass of its arguments.
        prog: the command as the user typed it.
        from_shell: whether the process runs only this command; compiled programs are then kept.
        joining: seconds that several processes wait for each other to start.
    """
    # Data and references are float64; models state their own precision.
    jax.config.update("jax_enable_x64", True)
    with as_one_line(prog, None):
        description = sys.modules[main.__module__].__doc__
        try:
            whole = parse(with_compilation_cache(arguments), prog=prog, description=description)
        finally:
            sys.stdout.flush()  # the help; raises BrokenPipeError here if its reader has closed the pipe
        given = whole.own
        require_possible(given)
        member = membership_in(given)
        if getattr(given, "resume", False):
            given = with_stored_arguments(given)
        before = compilation_cache.compilation() if from_shell else None
        unkept = compilation_cache.keep(whole.compilation_cache) if from_shell else ""

    began = IMPORTED if from_shell else time.perf_counter()

    def work(given: Arguments) -> None:
        with as_one_line(prog, given), losses_named(remedy_of(given)), counting_from(began):
            main(given)
            if before and (line := compilation_cache.summary(before, unkept)):
                print(line)
            sys.stdout.flush()

    if member is None:
        work(given)
        return
    with as_one_line(prog, given):
        given = joined(member, given, seconds=joining)
    try:
        work(given)
    except SystemExit as stop:
        end_at_once(stop.code if isinstance(stop.code, int) else 1)


@contextlib.contextmanager
def as_one_line(prog: str, given: Any) -> Iterator[None]:
    """Reports errors in one line and sets the exit status.

    A user's mistake, or memory, a device or disk space that the machine lacks, is 2, a refused fit 1, a lost process 3,
    an interrupt 130, a closed output pipe 141.
    """
    try:
        yield
    except FitRefused as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except ProcessLost as error:
        _say(f"error: {error}")
        raise SystemExit(3) from None
    except InputError as error:
        raise _refusal(str(error)) from None
    except MemoryError as error:
        raise _refusal(f"out of memory ({error or 'no more can be had'}); ask for less") from None
    except (RuntimeError, AssertionError) as error:
        if "RESOURCE_EXHAUSTED" in str(error):
            raise _refusal(f"out of memory ({str(error).splitlines()[0]:.200}); ask for less") from None
        if (line := unusable_platform()) is None:
            raise
        raise _refusal(line) from None
    except BrokenPipeError:  # the reader of the output has closed the pipe
        _say("")
        raise SystemExit(141) from None
    except OSError as error:  # a full disk, or a file that has been removed
        where = "" if error.filename is None else f"{error.filename}: "
        raise _refusal(f"{where}{error.strerror or error}") from None
    except KeyboardInterrupt as stop:
        _say(interrupted(prog, given, *stop.args))
        raise SystemExit(130) from None


def _refusal(message: str) -> SystemExit:
    """Prints an error as one line, and returns the exit for a user's mistake (status 2)."""
    shown = "".join(each if each.isprintable() else repr(each)[1:-1] for each in message)
    if len(shown) > 2 * MOST_CHARACTERS:
        shown = f"{shown[:MOST_CHARACTERS]} ... {shown[-MOST_CHARACTERS:]}"
    _say(f"error: {shown}")
    return SystemExit(2)


def _say(last: str) -> None:
    """Prints a command's last line on standard error. Redirects closed streams so that the exit raises no error."""
    for stream, text in ((sys.stdout, ""), (sys.stderr, last)):
        try:
            print(text, end="\n" if text else "", file=stream, flush=True)
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def with_compilation_cache(arguments: type) -> Any:
    """A dataclass with a command's own arguments, `own`, and the option of all commands, `compilation_cache`."""
    kept = not getattr(arguments, "MEASURES_COMPILATION", False)
    text = "Keep compiled programs for the next command, under the user's cache, 512 MiB at most"
    text += "." if kept else "; off where compilation is measured."
    return dataclasses.make_dataclass(
        "Whole",
        [
            ("own", Annotated[own_first(arguments), tyro.conf.arg(name="")]),
            ("compilation_cache", Annotated[bool, tyro.conf.arg(help=text)], kept),
        ],
    )


def interrupted(command: str, given: Any, folder: Path | None = None) -> str:
    """Message after an interrupt: how to resume the run, or that its folder is incomplete.

    A command can resume if its arguments have `resume`, unless they also have `continues` and it is false.
    """
    if folder is None:
        return "interrupted"
    if hasattr(given, "resume") and (folder / CONFIG).is_file():
        return f"interrupted; continue with: {command} --out {folder} --resume"
    return f"interrupted; {folder} is incomplete"


def require_possible(given: Any) -> None:
    """Raises `InputError` for an option that is not finite or is implausibly large."""
    for name, value in dataclasses.asdict(given).items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(value, float):
            if not math.isfinite(value):
                raise InputError(f"{option} is {value}; expected a finite number, or leave it out")
            require_magnitude(option, value)
        elif isinstance(value, int) and name == "seed":
            require_seed(value)
        elif isinstance(value, int):
            require_within({option: value})


def needs_from_option(text: str) -> Needs:
    """Parses --needs; `InputError` if the text does not state valid needs."""
    try:
        return needs_from_text(text)
    except InputError as error:
        raise InputError(f"--{error}; see --help for an example") from None


@contextlib.contextmanager
def command_folder(given: Any, command: str, **chosen: Any) -> Iterator[Path]:
    """Yields the run folder of a command. config.json gets the arguments, and the values `chosen` from them."""
    resume = getattr(given, "resume", False)
    resumable = hasattr(given, "resume")
    folder_of_run = (
        run_folder(given.out, command, resume=resume, resumable=resumable)
        if is_first(given)
        else copied_folder(given, resume)
    )
    with folder_of_run as folder:
        if resume:
            wait_for_all(given)
        write_config(folder, given, **chosen)
        yield folder
