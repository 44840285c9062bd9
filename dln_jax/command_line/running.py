"""What the command lines share: errors as one line, names for scenes, and the arguments that a run was started with."""

import contextlib
import dataclasses
import hashlib
import math
import os
import reprlib
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_type_hints

import jax
import tyro

from dln_jax.command_line import compilation_cache
from dln_jax.command_line.arguments import choice, own_first, parse
from dln_jax.command_line.scaled import (
    copied_folder,
    end_at_once,
    is_first,
    joined,
    membership_in,
    remedy_of,
    wait_for_all,
)
from dln_jax.data.schema import needs_from_text
from dln_jax.files import in_words, is_file, matches, read_json, write_json
from dln_jax.metrics.verdict import FitRefused
from dln_jax.scale.devices import unusable_platform
from dln_jax.scale.processes import JOINING, ProcessLost, losses_named
from dln_jax.scenes.registry import SCENES
from dln_jax.sizes import require_magnitude, require_within
from dln_jax.types import InputError, Needs, require_seed
from dln_jax.zoo.run_folder import CONFIG, run_folder

CHOSEN = "chosen"
"""Key in a run's config.json of what its arguments came to, beside these."""
FILES = "files"
"""Key of the SHA-256 of the files that are arguments, by their names."""
SCALE = ("devices", "processes", "coordinator", "process_id")
"""Arguments that say where a result is computed."""
PLACES = ("out", "resume", "figures", "low_latency", "uncertainty", *SCALE)
"""Arguments that do not decide the result."""
MOST_CHARACTERS = 400
"""Of each end of a message, of which the middle is left out if it is longer."""
CHANGEABLE = ("seconds",)
"""Arguments that may be given anew to --resume; a class of arguments may have others, as `CHANGEABLE`."""

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

    def work(given: Arguments) -> None:
        with as_one_line(prog, given), losses_named(remedy_of(given)):
            main(given)
            if before and (line := compilation_cache.summary(before, unkept)):
                print(line)
            sys.stdout.flush()

    if member is None:
        work(given)
        return
    try:
        with as_one_line(prog, given):
            given = joined(member, given, seconds=joining)
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


def write_config(folder: Path, given: Any, **chosen: Any) -> None:
    """Writes the arguments of a run into its folder, and what they came to."""
    files = fingerprints(stored_files(given))
    more = {CHOSEN: chosen} if chosen else {}
    write_json(folder / CONFIG, {**stored_arguments(given), **more, **({FILES: files} if files else {})})


def stored_arguments(given: Any) -> dict[str, Any]:
    """The arguments that decide the result, as JSON values."""
    values = dataclasses.asdict(given)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def stored_files(given: Any) -> dict[str, Path]:
    """The files that decide the result, by the names of their arguments."""
    values = dataclasses.asdict(given)
    return {key: v for key, v in values.items() if isinstance(v, Path) and key not in PLACES and is_file(v)}


def fingerprints(files: Mapping[str, Path]) -> dict[str, str]:
    """SHA-256 of each file, by which a resumed run knows it wherever it is."""
    found = {}
    for name, path in files.items():
        with path.open("rb") as file:
            found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found


def with_stored_arguments(given: Arguments) -> Arguments:
    """The arguments that the run in --out was started with; what is given anew must not differ.

    A file may have another path, if it is the same file.

    Raises:
        InputError: --out holds no run, one of other arguments or files, or one whose config.json is damaged.
    """
    folder = getattr(given, "out")  # noqa: B009  every script's arguments have it
    if folder is None or not is_file(folder / CONFIG):
        raise InputError(f"--resume continues the run in --out, but {folder or '--out'} holds none; name its folder")
    unset = stored_arguments(type(given)())
    stored = checked_arguments(folder / CONFIG, type(given), unset)
    changeable = (*CHANGEABLE, *getattr(type(given), "CHANGEABLE", ()))
    known = read_json(folder / CONFIG, remedy="restore it").get(FILES)
    known = known if isinstance(known, dict) else {}
    anew = stored_files(given)
    for key, digest in known.items():
        path = anew.get(key, Path(str(stored.get(key))))
        option = f"--{key.replace('_', '-')}"
        if not is_file(path):
            raise InputError(f"the run in {folder} reads {path}, which is not here; give its new path by {option}")
        if fingerprints({key: path})[key] != digest:
            raise InputError(
                f"the run in {folder} was started with other data than {path} has now (SHA-256); give the file it was "
                f"started with by {option}"
            )
        stored[key] = str(path)
    for key, value in stored_arguments(given).items():
        if key not in changeable and value not in (stored[key], unset[key]):
            option = key.replace("_", "-")
            raise InputError(f"the run in {folder} was started with {key} = {stored[key]}; leave --{option} out")
    hints = get_type_hints(type(given))
    stored |= {key: getattr(given, key) for key in changeable if getattr(given, key, None) is not None}
    for key, value in stored.items():
        if isinstance(value, str) and Path in (hints[key], *get_args(hints[key])):
            stored[key] = Path(value)
    return dataclasses.replace(cast(Any, given), **stored)


def checked_arguments(path: Path, arguments: type, expected: Collection[str]) -> dict[str, Any]:
    """The stored arguments in a config.json, each of the type that a script's arguments state for it.

    Raises:
        InputError: the file is damaged, or a release with other arguments has written it.
    """
    remedy = "restore the file, or train again into another folder"
    stored = read_json(path, remedy=remedy)
    for each in (CHOSEN, FILES):
        stored.pop(each, None)
    if absent := [key for key in expected if key not in stored]:
        raise InputError(f"{path}: {absent[0]} is missing; {remedy}")
    hints = get_type_hints(arguments)
    # What another release had and nobody gave decides nothing.
    stored = {key: value for key, value in stored.items() if key in expected or value not in (None, False)}
    for key, value in stored.items():
        if key not in expected:
            raise InputError(f"{path}: {key!r:.40} is no argument of this release; {remedy}")
        if not matches(value, hints[key]):
            raise InputError(f"{path}: {key} is {reprlib.repr(value)}; expected {in_words(hints[key])}; {remedy}")
    return stored
