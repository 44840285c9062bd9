"""What the command lines share: errors as one line, names for scenes, and folders for runs."""

import dataclasses
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import jax

from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.scenes.chain import chain
from dln_jax.scenes.double_pendulum import double_pendulum
from dln_jax.scenes.henon_heiles import henon_heiles
from dln_jax.scenes.mass_spring import mass_spring
from dln_jax.scenes.n_body import n_body
from dln_jax.scenes.pendulum import pendulum
from dln_jax.scenes.scene import Scene
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.types import InputError
from scripts.arguments import choice, parse

CONFIG = "config.json"
"""Name of the file in a run's folder that holds the arguments it was started with."""
PLACES = ("out", "resume", "figures", "low_latency")
"""Arguments that do not decide the result."""

SCENES: dict[str, Callable[[], Scene]] = {
    "two-link-arm": two_link_arm,
    "two-link-arm-hanging": lambda: two_link_arm(zero="hanging"),
    "pendulum": pendulum,
    "double-pendulum": double_pendulum,
    "cart-pole": cart_pole,
    "mass-spring": mass_spring,
    "henon-heiles": henon_heiles,
    "two-body": lambda: n_body(2),
    "three-body": lambda: n_body(3),
    **{f"chain-{d}": (lambda d=d: chain(d)) for d in range(1, 13)},
}
SceneName = Annotated[str, choice(SCENES)]

Arguments = TypeVar("Arguments")


def run(main: Callable[[Arguments], None], arguments: type[Arguments]) -> None:
    """Parses the command line and runs `main`: a user's mistake is one line and exit status 2, an interrupt 130."""
    # Data and references are float64; models state their own precision.
    jax.config.update("jax_enable_x64", True)
    module = sys.modules[main.__module__]
    name = module.__spec__.name if module.__spec__ else module.__name__
    try:
        main(parse(arguments, prog=f"python -m {name}", description=module.__doc__))
        sys.stdout.flush()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        # Whoever read the output has gone; the interpreter must not try to flush it once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    except KeyboardInterrupt as stop:
        print("\n".join(["interrupted", *map(str, stop.args)]), file=sys.stderr)
        raise SystemExit(130) from None


def scene_named(name: str) -> Scene:
    """The scene of a name; `InputError` lists the names."""
    if name not in SCENES:
        raise InputError(f"scene '{name}' is unknown; choose from {', '.join(SCENES)}")
    return SCENES[name]()


def new_folder(path: Path | None, default: str) -> Path:
    """Creates the folder for a run: the path given, or the first free number behind `runs/default`.

    Raises:
        InputError: the folder holds something already, or cannot be created.
    """
    if path is None:
        number = 1
        while (path := Path("runs") / f"{default}-{number}").exists():
            number += 1
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path} is not empty; choose another --out, or --resume the run in it")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot create the folder ({error.strerror}); choose another --out") from error
    return path


def stored_arguments(given: Any) -> dict[str, Any]:
    """The arguments that decide the result, as JSON values."""
    values = dataclasses.asdict(given)
    return {key: str(v) if isinstance(v, Path) else v for key, v in values.items() if key not in PLACES}


def with_stored_arguments(given: Arguments) -> Arguments:
    """The arguments that the run in --out was started with; what is given anew must not differ.

    Raises:
        InputError: --out holds no run, or one of other arguments.
    """
    folder = getattr(given, "out")  # noqa: B009  every script's arguments have it
    if folder is None or not (folder / CONFIG).is_file():
        raise InputError(f"--resume continues the run in --out, but {folder or '--out'} holds none; name its folder")
    stored = json.loads((folder / CONFIG).read_text())
    unset = stored_arguments(type(given)())
    for key, value in stored_arguments(given).items():
        if value not in (stored.get(key), unset[key]):
            option = key.replace("_", "-")
            raise InputError(f"the run in {folder} was started with {key} = {stored.get(key)}; leave --{option} out")
    kept = {key: value for key, value in stored.items() if key in unset}
    if kept.get("data") is not None:
        kept["data"] = Path(kept["data"])
    return dataclasses.replace(cast(Any, given), **kept)


def cache_folder() -> Path:
    """Folder for generated default data: `$XDG_CACHE_HOME/dln_jax`, by default `~/.cache/dln_jax`."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "dln_jax"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
