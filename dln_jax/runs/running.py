"""Shared parts of the command lines: one-line errors, scene names, and run folders."""

import contextlib
import dataclasses
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from dln_jax.errors import FitRefused, InputError, ProcessLost, require_magnitude, require_within
from dln_jax.options import CompilationCache, Folder, NoCompilationCache, Scaled
from dln_jax.process import counting_from
from dln_jax.runs.arguments import parse

MOST_CHARACTERS = 400
"""Characters shown at either end of a long message; the middle is left out."""
INTERRUPTED = 130
"""Exit status after an interrupt, as in shells."""


def run(
    main: Callable[[Any], None],
    arguments: type,
    *,
    prog: str,
    line: Sequence[str] | None = None,
    description: str | None = None,
    began: float | None = None,
    joining: int | None = None,
) -> None:
    """Parses the command line and runs `main`; errors and exit statuses as for `as_one_line`.

    Args:
        prog: the command as the user typed it.
        line: words after the command (default: those of this process).
        description: what the command does, for its help (default: the docstring of the module of `main`).
        began: reading of `time.perf_counter` at the start of a process that runs only this command, whose compiled
            programs are then kept and whose time limit counts from there (default: a call within a program).
        joining: seconds that several processes wait for each other to start (default: that of `scale`).
    """
    from_shell = began is not None
    with as_one_line(prog, None):
        common = NoCompilationCache if getattr(arguments, "MEASURES_COMPILATION", False) else CompilationCache
        description = description or sys.modules[main.__module__].__doc__
        line = sys.argv[1:] if line is None else line
        try:
            own, shared = parse(arguments, prog=prog, description=description, line=line, common=common)
        finally:
            sys.stdout.flush()  # the help; raises BrokenPipeError here if its reader has closed the pipe
        require_possible(own)
        # JAX takes a second to import, which the help and a mistake do not need.
        import jax

        from dln_jax.runs import devices
        from dln_jax.runs.folder import require_free, with_stored_arguments
        from dln_jax.runs.progress import heartbeat
        from dln_jax.scale import losses_named

        # Data and references are float64; models state their own precision.
        jax.config.update("jax_enable_x64", True)
        member = devices.membership_in(own) if isinstance(own, Scaled) else None
        if getattr(own, "resume", False):
            options = with_stored_arguments(own, arguments)
        else:
            options = own
            if isinstance(own, Folder) and own.out is not None:
                require_free(own.out, hasattr(own, "resume"))  # before data are read
        if from_shell:
            devices.compilation()["unkept"] = devices.keep_programs(shared.compilation_cache)

    start = began if began is not None else time.perf_counter()

    def work(options: Any) -> None:
        nothing = contextlib.nullcontext()
        lost = nothing
        if member is not None:
            remedy = "start all processes again"
            if hasattr(options, "resume"):
                remedy = f"continue from the last checkpoint in {options.out} with --resume in all processes"
            lost = losses_named(remedy)
        with as_one_line(prog, options), lost, counting_from(start), heartbeat(start) if from_shell else nothing:
            main(options)
            devices.print_compilation()
            sys.stdout.flush()

    if member is not None:
        with as_one_line(prog, options):
            options = devices.joined(member, options, **({} if joining is None else {"seconds": joining}))
    try:
        work(options)
    except SystemExit as stop:
        # After an interrupt XLA may still run a program, and would abort a process that ends under it.
        if member is None and not (from_shell and stop.code == INTERRUPTED):
            raise
        devices.end_at_once(stop.code if isinstance(stop.code, int) else 1)


@contextlib.contextmanager
def as_one_line(prog: str, options: Any) -> Iterator[None]:
    """Reports errors in one line and sets the exit status.

    The status is 2 for a user's mistake, and for memory, devices or disk space that the machine lacks; 1 for a refused
    fit, 3 for a lost process, 130 for an interrupt, 141 for a closed output pipe.
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
        raise _refusal(f"out of memory ({error or 'no more is available'}); ask for less") from None
    except (RuntimeError, AssertionError) as error:
        if "RESOURCE_EXHAUSTED" in str(error):
            raise _refusal(f"out of memory ({str(error).splitlines()[0]:.200}); ask for less") from None
        from dln_jax.scale import unusable_platform

        if (text := unusable_platform()) is None:
            raise
        raise _refusal(text) from None
    except BrokenPipeError:  # the reader of the output has closed the pipe
        _say("")
        raise SystemExit(141) from None
    except OSError as error:  # a full disk, or a file that has been removed
        where = "" if error.filename is None else f"{error.filename}: "
        raise _refusal(f"{where}{error.strerror or error}") from None
    except KeyboardInterrupt as stop:
        _say(interrupted(prog, options, *stop.args))
        raise SystemExit(INTERRUPTED) from None


def _refusal(message: str) -> SystemExit:
    """Prints an error as one line, and returns the exit for a user's mistake (status 2)."""
    shown = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in message)
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


def interrupted(command: str, options: Any, folder: Path | None = None) -> str:
    """Message after an interrupt: how to resume (if the arguments have `resume`), or that the folder is incomplete."""
    if folder is None:
        return "interrupted"
    if hasattr(options, "resume") and (folder / "config.json").is_file():
        return f"interrupted; continue with: {command} --out {folder} --resume"
    return f"interrupted; {folder} is incomplete"


def require_possible(options: Any) -> None:
    """Raises `InputError` for an option that is not finite or is implausibly large."""
    from dln_jax.types import require_seed  # imports JAX

    counts = {}
    for name, value in dataclasses.asdict(options).items():
        option = f"--{name.replace('_', '-')}"
        if isinstance(value, float):
            if not math.isfinite(value):
                raise InputError(f"{option} is {value}; expected a finite number, or leave it out")
            require_magnitude(option, value)
        elif isinstance(value, int) and name == "seed":
            require_seed(value, getattr(options, "seeds", 1))
        elif isinstance(value, int):
            counts[option] = value
    require_within(counts)
