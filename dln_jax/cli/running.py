"""What the command lines share: errors as one line, names for scenes, and the folder of a run."""

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
"""Of each end of a message, of which the middle is left out if it is longer."""
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
    """Parses the command line and runs `main`: a user's mistake is one line and exit status 2, a refused fit 1,
    a lost process 3, an interrupt 130.

    `prog` is what the user typed; `from_shell`, that the process is the command's own, which keeps compiled programs;
    `joining`, how many seconds several processes wait for each other to be started.
    """
    # Data and references are float64; models state their own precision.
    jax.config.update("jax_enable_x64", True)
    with as_one_line(prog, None):
        description = sys.modules[main.__module__].__doc__
        try:
            whole = parse(with_compilation_cache(arguments), prog=prog, description=description)
        finally:
            sys.stdout.flush()  # the help, perhaps to somebody who has gone
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
    """Turns mistakes, and what the machine lacks, into one line and status 2.

    A refused fit is 1, a lost process 3, an interrupt 130.
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
    except BrokenPipeError:  # whoever read the output has gone
        _say("")
        raise SystemExit(141) from None
    except OSError as error:  # a disk that is full, or a file that is there no more
        where = "" if error.filename is None else f"{error.filename}: "
        raise _refusal(f"{where}{error.strerror or error}") from None
    except KeyboardInterrupt as stop:
        _say(interrupted(prog, given, *stop.args))
        raise SystemExit(130) from None


def _refusal(message: str) -> SystemExit:
    """Prints a message as one line, and gives the exit of a user's mistake."""
    shown = "".join(each if each.isprintable() else repr(each)[1:-1] for each in message)
    if len(shown) > 2 * MOST_CHARACTERS:
        shown = f"{shown[:MOST_CHARACTERS]} ... {shown[-MOST_CHARACTERS:]}"
    _say(f"error: {shown}")
    return SystemExit(2)


def _say(last: str) -> None:
    """Says a command's last word, and keeps the interpreter from complaining that it cannot write as it ends."""
    for stream, text in ((sys.stdout, ""), (sys.stderr, last)):
        try:
            print(text, end="\n" if text else "", file=stream, flush=True)
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def with_compilation_cache(arguments: type) -> Any:
    """A dataclass of a command's own arguments, `own`, and of `compilation_cache`, the one that all commands have."""
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
    """What a user is told whose interrupt ended a command, in whose folder there may be a run to continue.

    A command continues if its arguments have `resume`, unless they have `continues` too, and that is false.
    """
    if folder is None:
        return "interrupted"
    if hasattr(given, "resume") and getattr(given, "continues", True) and (folder / CONFIG).is_file():
        return f"interrupted; continue with: {command} --out {folder} --resume"
    return f"interrupted; {folder} is incomplete"


def require_possible(given: Any) -> None:
    """Raises `InputError` for a number that is not finite, or so large that it must be a mistake."""
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
    """The needs that --needs states; `InputError` for what states none."""
    try:
        return needs_from_text(text)
    except InputError as error:
        raise InputError(f"--{error}; see --help for an example") from None


@contextlib.contextmanager
def command_folder(given: Any, command: str, **chosen: Any) -> Iterator[Path]:
    """Yields the run folder of a command, with its arguments in config.json, and beside them what they came to."""
    resume = getattr(given, "resume", False)
    resumable = hasattr(given, "resume") and getattr(given, "continues", True)
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
