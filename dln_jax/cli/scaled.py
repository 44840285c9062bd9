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

from dln_jax.cli.options import Scaled
from dln_jax.files import PARTIAL
from dln_jax.scale import processes
from dln_jax.scale.meeting import Membership
from dln_jax.scale.mesh import batch_mesh
from dln_jax.types import InputError

SEEN_BY_USERS = ("figures", "low_latency")
"""Options for output that only the first process produces."""


def mesh_of(given: Scaled) -> Mesh | None:
    """The mesh of devices that share a command's batches; `None` for a single device.

    A single process defaults to one device: most networks are small, and sharing them is slower.

    Raises:
        InputError: the machine has fewer devices.
    """
    alone = jax.process_count() == 1
    return batch_mesh(1 if alone and given.devices is None else given.devices)


def membership_in(given: Any) -> Membership | None:
    """How this process joins others; `None` for a single process. On a CPU, sets the number of devices.

    Raises:
        InputError: the options or the cluster's environment variables are inconsistent, or --out is missing.
    """
    if not isinstance(given, Scaled):
        return None
    processes.host_devices(given.devices)
    member = processes.membership(given.processes, given.coordinator, given.process_id)
    if member is not None and getattr(given, "out", None) is None:
        raise InputError("several processes share their run's folder; name one that all hosts see, by --out")
    return member


def joined(member: Membership, given: Any, *, seconds: int) -> Any:
    """Joins the other processes of a command and returns the arguments of this one; errors as `processes.join`."""
    own = {"processes", "coordinator", "process_id", "out", *SEEN_BY_USERS}
    shared = {
        key: str(v) if isinstance(v, Path) else v for key, v in dataclasses.asdict(given).items() if key not in own
    }
    _keep_standard_output_to_python()
    processes.join(member, {f"--{key.replace('_', '-')}": value for key, value in shared.items()}, seconds=seconds)
    here: dict[str, Any] = {"processes": jax.process_count(), "process_id": jax.process_index()}
    if jax.process_index():
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115  open until the process ends
        here |= {name: False for name in SEEN_BY_USERS if hasattr(given, name)}
    return dataclasses.replace(given, **here)


def _keep_standard_output_to_python() -> None:
    """Drops output that libraries print past Python: gloo reports every connection on standard output."""
    sys.stdout.flush()
    sys.stdout = open(os.dup(1), "w", buffering=1, errors=sys.stdout.errors)  # noqa: SIM115  open until the process ends
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def remedy_of(given: Any) -> str:
    """Advice to the user after a process was lost."""
    if not (hasattr(given, "resume") and getattr(given, "continues", True)):
        return "start all processes again"
    return f"continue from the last checkpoint in {getattr(given, 'out', '--out')} with --resume in all processes"


def end_at_once(code: int) -> NoReturn:
    """Ends this process at once; JAX's own shutdown would wait for the others."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(code)


def is_first(given: Any) -> bool:
    """Whether this process writes the results."""
    return not getattr(given, "process_id", None)


def wait_for_all(given: Any) -> None:
    """Waits until all processes have reached this call."""
    if (getattr(given, "processes", None) or 1) > 1:
        from jax.experimental import multihost_utils  # takes long to import

        multihost_utils.sync_global_devices("all are here")


@contextlib.contextmanager
def copied_folder(given: Any, resume: bool) -> Iterator[Path]:
    """Yields a temporary folder for this process, with a copy of the run if it is resumed.

    Raises:
        InputError: the run's folder cannot be copied.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if resume:
            try:
                shutil.copytree(given.out, folder, ignore=shutil.ignore_patterns(f"*{PARTIAL}"), dirs_exist_ok=True)
            except (OSError, shutil.Error) as error:
                reason = getattr(error, "strerror", None) or "not all of it could be read"
                raise InputError(
                    f"{given.out}: cannot be copied ({reason}); it must be one that all hosts see"
                ) from None
        try:
            yield folder
        except KeyboardInterrupt:
            raise KeyboardInterrupt(given.out) from None
