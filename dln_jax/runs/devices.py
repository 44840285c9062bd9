"""Commands on several devices and processes (the first process prints and writes), and the cache of programs.

Compiled programs are reused between commands by JAX's persistent compilation cache. Only commands turn it on, never the
library. Programs are stored in the user's cache folder. JAX's key contains the computation, the version of JAX, XLA's
options and the kind of processor.
"""

import contextlib
import dataclasses
import functools
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax
from filelock import FileLock, Timeout
from jax.sharding import Mesh

from dln_jax.files import PARTIAL, cache_folder
from dln_jax.options import Drawn
from dln_jax.scale import JOINING, Membership, backend_started, batch_mesh, host_devices, join, membership
from dln_jax.types import InputError

MOST_BYTES = 512 * 2**20
"""Size limit of the cache folder; the least recently used program is evicted first."""
LEAST_SECONDS = 0.05
"""Shortest compilation time of a program that is stored; reading one back takes 0.01 s."""
LOCK = ".lockfile"
"""JAX's lock file: one process at a time reads or writes."""


def mesh_of(options: Any) -> Mesh | None:
    """The mesh of devices that share a command's batches; `None` for a single device.

    A single process defaults to one device: most networks are small, and sharing them is slower.

    Raises:
        InputError: the machine has fewer devices.
    """
    alone = jax.process_count() == 1
    return batch_mesh(1 if alone and options.devices is None else options.devices)


def membership_in(options: Any) -> Membership | None:
    """Returns the arguments for joining other processes; `None` for a single process. Sets a CPU's number of devices.

    Raises:
        InputError: the options or the cluster's environment variables are inconsistent, or --out is missing.
    """
    host_devices(options.devices)
    member = membership(options.processes, options.coordinator, options.process_id)
    if member is not None and getattr(options, "out", None) is None:
        raise InputError("several processes need --out, a run folder that all hosts can see")
    return member


def joined(member: Membership, options: Any, *, seconds: int = JOINING) -> Any:
    """Joins the other processes of a command and returns the arguments of this one.

    Raises:
        InputError: JAX has been used. Errors of `join` end the process with one line and status 2.
    """
    if backend_started():
        raise InputError("JAX has been used in this process; start several processes before that")
    own = {"processes", "coordinator", "process_id", "out", "figures"}
    shared = {
        f"--{key.replace('_', '-')}": str(value) if isinstance(value, Path) else value
        for key, value in dataclasses.asdict(options).items()
        if key not in own
    }
    # gloo reports every connection on standard output: only Python's own output goes there from now on.
    sys.stdout.flush()
    sys.stdout = open(os.dup(1), "w", buffering=1, errors=sys.stdout.errors)  # noqa: SIM115  open until the process ends
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    try:
        join(member, shared, seconds=seconds)
    except (InputError, KeyboardInterrupt) as error:
        mistake = isinstance(error, InputError)
        print(f"error: {error}" if mistake else "interrupted", file=sys.stderr)
        end_at_once(2 if mistake else 130)
    here: dict[str, Any] = {"processes": jax.process_count(), "process_id": jax.process_index()}
    if jax.process_index():
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  open until the process ends
        here |= {"figures": False} if isinstance(options, Drawn) else {}
    return dataclasses.replace(options, **here)


def end_at_once(code: int) -> NoReturn:
    """Ends this process at once, without JAX's own shutdown, which would wait for the other processes."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(code)


@contextlib.contextmanager
def copied_folder(options: Any, resume: bool) -> Iterator[Path]:
    """Yields a temporary folder for this process, with a copy of a resumed run; `InputError` if it cannot be copied."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if resume:
            try:
                shutil.copytree(options.out, folder, ignore=shutil.ignore_patterns(f"*{PARTIAL}"), dirs_exist_ok=True)
            except (OSError, shutil.Error) as error:
                reason = getattr(error, "strerror", None) or "not all of it could be read"
                raise InputError(
                    f"{options.out}: cannot be copied ({reason}); all hosts must see this folder"
                ) from None
        try:
            yield folder
        except KeyboardInterrupt:
            raise KeyboardInterrupt(options.out) from None


def keep_programs(wanted: bool) -> str:
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
def compilation() -> dict[str, Any]:
    """Totals since the last print, or since the first call of this function; updated in place.

    `seconds` is the compilation time, including programs from the cache; `cached` is the number of these; `unkept` is
    the reason if programs are not kept.
    """
    counts: dict[str, Any] = {"seconds": 0.0, "cached": 0, "unkept": ""}

    def count(event: str, **_: str | int) -> None:
        counts["cached"] += event == "/jax/compilation_cache/cache_hits"

    def add(event: str, duration_secs: float, **_: str | int) -> None:
        counts["seconds"] += duration_secs if event == "/jax/core/compile/backend_compile_duration" else 0.0

    jax.monitoring.register_event_listener(count)
    jax.monitoring.register_event_duration_secs_listener(add)
    return counts


def print_compilation() -> None:
    """Prints the compilation time since the last call, if it is counted and long, or if the cache was used."""
    if not compilation.cache_info().currsize:
        return
    seconds, cached, unkept = compilation().values()
    if seconds >= 0.5 or cached:
        why = f" (none is kept: {unkept})" if unkept else ""
        print(f"compilation took {seconds:.1f} s; programs from the cache: {cached}{why}")
        compilation().update(seconds=0.0, cached=0)


def _remove_torn(folder: Path) -> None:
    """Removes half-written programs, which lack an access time: JAX 0.10 would store no others beside them."""
    try:
        with FileLock(folder / LOCK, timeout=0):
            for program in folder.glob("*-cache"):
                if not program.with_name(program.name.removesuffix("-cache") + "-atime").exists():
                    program.unlink(missing_ok=True)
    except Timeout:  # another command holds the lock and has done this
        pass
