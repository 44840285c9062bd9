"""Reuse of compiled programs between commands, by JAX's persistent compilation cache.

Only commands turn the cache on, never the library. Programs are stored in the user's cache folder. JAX's key contains
the computation, the version of JAX, XLA's options and the kind of processor.
"""

import functools
import warnings
from pathlib import Path

import jax
from filelock import FileLock, Timeout

from dln_jax.files import cache_folder
from dln_jax.types import InputError

MOST_BYTES = 512 * 2**20
"""Size limit of the cache folder; the least recently used program is evicted first."""
LEAST_SECONDS = 0.05
"""Shortest compilation time of a program that is stored; reading one back takes 0.01 s."""
LOCK = ".lockfile"
"""JAX's lock file: one process at a time reads or writes."""


def enable_double_precision() -> None:
    """Turns on float64 for data and references."""
    jax.config.update("jax_enable_x64", True)


def keep(wanted: bool) -> str:
    """Turns the cache on or off. Returns the reason if it cannot be turned on, else an empty string.

    A cache folder that the user has set (`JAX_COMPILATION_CACHE_DIR`) keeps its settings.
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
    # A full disk or an unreadable program costs a compilation; one warning per program would flood the output.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    return ""


@functools.cache
def compilation() -> dict[str, float]:
    """Totals since the first call of this function, which are updated in place.

    `seconds` is the compilation time, including programs that came from the cache; `cached` is the number of these.
    """
    counts = {"seconds": 0.0, "cached": 0}

    def count(event: str, **_: str | int) -> None:
        counts["cached"] += event == "/jax/compilation_cache/cache_hits"

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        counts["seconds"] += duration_secs if event == "/jax/core/compile/backend_compile_duration" else 0.0

    jax.monitoring.register_event_listener(count)
    jax.monitoring.register_event_duration_secs_listener(add)
    return counts


def summary(since: dict[str, float], unkept: str = "") -> str:
    """Summary of the compilation since a copy of the totals, in one line; empty if it was short and used no cache."""
    seconds, cached = (now - since[name] for name, now in compilation().items())
    if seconds < 0.5 and not cached:
        return ""
    many = {0: "no program", 1: "one program"}.get(int(cached), f"{cached} programs")
    why = f" (none is kept: {unkept})" if unkept else ""
    return f"compilation took {seconds:.1f} s; {many} came from the cache{why}"


def _remove_torn(folder: Path) -> None:
    """Removes programs that a kill left half-written, without an access time: beside them JAX 0.10 stores no others."""
    try:
        with FileLock(folder / LOCK, timeout=0):
            for program in folder.glob("*-cache"):
                if not program.with_name(program.name.removesuffix("-cache") + "-atime").exists():
                    program.unlink(missing_ok=True)
    except Timeout:  # another command holds the lock and has done this
        pass
