"""What the command lines share: errors as one line, names for scenes, and the arguments that a run was started with."""

import contextlib
import dataclasses
import math
import os
import reprlib
import sys
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args, get_type_hints

import jax
import tyro

from dln_jax.command_line import compilation_cache
from dln_jax.command_line.arguments import choice, own_first, parse
from dln_jax.command_line.scaled import copied_folder, in_processes, is_first, place_in, wait_for_all
from dln_jax.data.schema import needs_from_text
from dln_jax.files import is_file, matches, read_json, write_json
from dln_jax.metrics.verdict import FitRefused
from dln_jax.scale.devices import unusable_platform
from dln_jax.scale.signs import USUAL, Limits
from dln_jax.scenes.registry import SCENES
from dln_jax.types import InputError, Needs
from dln_jax.zoo.run_folder import CONFIG, run_folder

CHOSEN = "chosen"
"""Key in a run's config.json of what its arguments came to, beside these."""
SCALE = ("devices", "processes", "coordinator", "process_id")
"""Arguments that say where a result is computed."""
PLACES = ("out", "resume", "figures", "low_latency", "uncertainty", *SCALE)
"""Arguments that do not decide the result."""
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
    limits: Limits = USUAL,
) -> None:
    """Parses the command line and runs `main`: a user's mistake is one line and exit status 2, a refused fit 1,
    an interrupt 130.

    `prog` is what the user typed; `from_shell`, that the process is the command's own, which keeps compiled programs;
    `limits` are those of several processes, of which each works in a child.
    """
    # Data and references are float64; models state their own precision.
    jax.config.update("jax_enable_x64", True)
    with in_words(prog, None):
        description = sys.modules[main.__module__].__doc__
        refuse_moved(arguments)
        whole = parse(with_compilation_cache(arguments), prog=prog, description=description)
        given = whole.own
        require_storable(given)
        place = place_in(given)
        if getattr(given, "resume", False):
            given = with_stored_arguments(given)
        before = compilation_cache.compilation() if from_shell else None
        unkept = compilation_cache.keep(whole.compilation_cache) if from_shell else ""

    def work(given: Arguments) -> None:
        with in_words(prog, given):
            main(given)
            if before and (line := compilation_cache.summary(before, unkept)):
                print(line)
            sys.stdout.flush()

    if place is None:
        work(given)
        return
    with in_words(prog, given):
        raise SystemExit(in_processes(work, given, place, limits))


@contextlib.contextmanager
def in_words(prog: str, given: Any) -> Iterator[None]:
    """Turns a user's mistake into one line and exit status 2, a refused fit into 1, and an interrupt into 130."""
    try:
        yield
    except FitRefused as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except (RuntimeError, AssertionError):
        if (line := unusable_platform()) is None:
            raise
        print(f"error: {line}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        # Whoever read the output has gone; the interpreter must not try to flush it once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except KeyboardInterrupt as stop:
        print(interrupted(prog, given, *stop.args), file=sys.stderr)
        raise SystemExit(130) from None


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


def refuse_moved(arguments: type) -> None:
    """Raises `InputError` for an option that has become a command; a class of arguments has them as `MOVED`."""
    for option, where in getattr(arguments, "MOVED", {}).items():
        if any(word.partition("=")[0] == option for word in sys.argv[1:]):
            raise InputError(f"{option} is a command of its own now: {where}")


def require_storable(given: Any) -> None:
    """Raises `InputError` for a number that is not finite: a run's config.json could not hold it."""
    for name, value in dataclasses.asdict(given).items():
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"--{name.replace('_', '-')} is {value}; expected a finite number, or leave it out")


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
    folder_of_run = run_folder(given.out, command, resume=resume) if is_first(given) else copied_folder(given, resume)
    with folder_of_run as folder:
        if resume:
            wait_for_all(given)
        write_config(folder, given, **chosen)
        yield folder


def write_config(folder: Path, given: Any, **chosen: Any) -> None:
    """Writes the arguments of a run into its folder, and what they came to."""
    write_json(folder / CONFIG, {**stored_arguments(given), **({CHOSEN: chosen} if chosen else {})})


def stored_arguments(given: Any) -> dict[str, Any]:
    """The arguments that decide the result, as JSON values."""
    values = dataclasses.asdict(given)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def with_stored_arguments(given: Arguments) -> Arguments:
    """The arguments that the run in --out was started with; what is given anew must not differ.

    Raises:
        InputError: --out holds no run, one of other arguments, or one whose config.json is damaged.
    """
    folder = getattr(given, "out")  # noqa: B009  every script's arguments have it
    if folder is None or not is_file(folder / CONFIG):
        raise InputError(f"--resume continues the run in --out, but {folder or '--out'} holds none; name its folder")
    unset = stored_arguments(type(given)())
    stored = checked_arguments(folder / CONFIG, type(given), unset)
    changeable = (*CHANGEABLE, *getattr(type(given), "CHANGEABLE", ()))
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
    stored.pop(CHOSEN, None)
    if absent := [key for key in expected if key not in stored]:
        raise InputError(f"{path}: {absent[0]} is missing; {remedy}")
    hints = get_type_hints(arguments)
    # What another release had and nobody gave decides nothing.
    stored = {key: value for key, value in stored.items() if key in expected or value not in (None, False)}
    for key, value in stored.items():
        if where := getattr(arguments, "MOVED", {}).get(f"--{key}"):
            raise InputError(f"{path}: a run with --{key}, which is a command of its own now: {where}; train it again")
        if key not in expected:
            raise InputError(f"{path}: {key!r:.40} is no argument of this release; {remedy}")
        if not matches(value, hints[key]):
            wanted = str(getattr(hints[key], "__name__", hints[key])).replace("typing.", "").replace("pathlib.", "")
            raise InputError(f"{path}: {key} is {reprlib.repr(value)}, expected {wanted}; {remedy}")
    return stored
