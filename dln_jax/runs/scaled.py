"""Commands on several devices and in several processes; the first process prints and writes."""

import contextlib
import dataclasses
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax
from jax.sharding import Mesh

from dln_jax.files import PARTIAL
from dln_jax.options import Drawn
from dln_jax.scale import JOINING, Membership, backend_started, batch_mesh, host_devices, join, membership
from dln_jax.types import InputError


def mesh_of(options: Any) -> Mesh | None:
    """The mesh of devices that share a command's batches; `None` for a single device.

    A single process defaults to one device: most networks are small, and sharing them is slower.

    Raises:
        InputError: the machine has fewer devices.
    """
    alone = jax.process_count() == 1
    return batch_mesh(1 if alone and options.devices is None else options.devices)


def membership_in(options: Any) -> Membership | None:
    """How this process joins others; `None` for a single process. On a CPU, sets the number of devices.

    Raises:
        InputError: the options or the cluster's environment variables are inconsistent, or --out is missing.
    """
    host_devices(options.devices)
    member = membership(options.processes, options.coordinator, options.process_id)
    if member is not None and getattr(options, "out", None) is None:
        raise InputError("several processes share their run's folder; name one that all hosts see, by --out")
    return member


def joined(member: Membership, options: Any, *, seconds: int = JOINING) -> Any:
    """Joins the other processes of a command and returns the arguments of this one.

    Raises:
        InputError: JAX has been used. Errors of `join` end the process with one line and status 2.
    """
    if backend_started():
        raise InputError("JAX has been used in this process; several are started before it is")
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


def remedy_of(options: Any) -> str:
    """Advice to the user after a process was lost."""
    if not hasattr(options, "resume"):
        return "start all processes again"
    return f"continue from the last checkpoint in {getattr(options, 'out', '--out')} with --resume in all processes"


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
                    f"{options.out}: cannot be copied ({reason}); it must be one that all hosts see"
                ) from None
        try:
            yield folder
        except KeyboardInterrupt:
            raise KeyboardInterrupt(options.out) from None
