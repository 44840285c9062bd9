"""Compiled programs that are kept from one command to the next, by JAX's persistent compilation cache.

Only commands turn it on, never the library. Programs are kept under the user's cache, for each version of JAX, XLA's
options and kind of processor apart (JAX's own key), and found by what they compute.
"""

import functools
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
from filelock import FileLock, Timeout

from dln_jax.files import cache_folder
from dln_jax.types import InputError

MOST_BYTES = 512 * 2**20
"""Of the folder; the program that was used longest ago goes first."""
LEAST_SECONDS = 0.05
"""Of compilation, from which on a program is kept: to read one takes 0.01."""
LOCK = ".lockfile"
"""By which JAX lets one process at a time read or write."""


class Compilation(NamedTuple):
    """What this process has compiled."""

    seconds: float
    """What was found in the cache included."""
    found: int
    """Programs that came from the cache."""


def keep(wanted: bool) -> str:
    """Turns the cache on, or off if it is not wanted; gives the reason where it cannot be on, and all is compiled anew.

    A folder that the user has told JAX (`JAX_COMPILATION_CACHE_DIR`) stays, with its settings.
    """
    if not wanted:
        jax.config.update("jax_enable_compilation_cache", False)
    if not wanted or jax.config.values.get("jax_compilation_cache_dir"):
        return ""
    try:
        folder = cache_folder() / "programs"
        folder.mkdir(exist_ok=True)
        _remove_torn(folder)
    except (InputError, OSError, NotImplementedError) as error:  # the last: no locks on that kind of disk
        return str(error)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", MOST_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST_SECONDS)
    # A disk that is full, or a program that cannot be read, costs its compilation and not a line for each program.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    return ""


def compilation() -> Compilation:
    """What has been compiled since this was first asked for; a difference of two is what was in between."""
    counts = _counts()
    return Compilation(counts["seconds"], int(counts["found"]))


def summary(since: Compilation, unkept: str = "") -> str:
    """A line about compilation; empty where it was not worth one."""
    now = compilation()
    seconds, found = now.seconds - since.seconds, now.found - since.found
    if seconds < 0.5 and not found:
        return ""
    many = {0: "no program", 1: "one program"}.get(found, f"{found} programs")
    why = f" (none is kept: {unkept})" if unkept else ""
    return f"compilation took {seconds:.1f} s; {many} came from the cache{why}"


@functools.cache
def _counts() -> dict[str, float]:
    counts = {"seconds": 0.0, "found": 0}

    def count(event: str, **_: str | int) -> None:
        counts["found"] += event == "/jax/compilation_cache/cache_hits"

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        counts["seconds"] += duration_secs if event == "/jax/core/compile/backend_compile_duration" else 0.0

    jax.monitoring.register_event_listener(count)
    jax.monitoring.register_event_duration_secs_listener(add)
    return counts


def _remove_torn(folder: Path) -> None:
    """Removes programs that a kill left half-written: JAX writes when one was used after the program itself.

    JAX 0.10 would keep nothing more beside one.
    """
    try:
        with FileLock(folder / LOCK, timeout=0):
            for program in folder.glob("*-cache"):
                if not program.with_name(program.name.removesuffix("-cache") + "-atime").exists():
                    program.unlink(missing_ok=True)
    except Timeout:  # another command is at work there, which has looked
        pass
