"""A command that works on several devices, and in several processes, of which the first prints and writes."""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
from jax.sharding import Mesh

from dln_jax.command_line.options import Scaled
from dln_jax.files import PARTIAL
from dln_jax.scale import processes
from dln_jax.scale.mesh import batch_mesh
from dln_jax.scale.places import Place, place_of
from dln_jax.scale.signs import Limits
from dln_jax.types import InputError

SEEN_BY_USERS = ("figures", "low_latency")
"""What the first process alone does."""

Arguments = TypeVar("Arguments")


def mesh_of(given: Scaled) -> Mesh | None:
    """The devices that share a command's batches, `None` where that is one alone.

    One process takes one device unless it is asked for more: most networks are small, and lose by being shared.

    Raises:
        InputError: there are not so many.
    """
    alone = jax.process_count() == 1
    return batch_mesh(1 if alone and given.devices is None else given.devices)


def place_in(given: Any) -> Place | None:
    """This process's place among several, `None` where it is alone; it has the devices that a command asks for.

    Raises:
        InputError: what is given, or what Slurm says, is no place, or no folder that all processes see is named.
    """
    if not isinstance(given, Scaled):
        return None
    processes.host_devices(given.devices)
    place = place_of(given.processes, given.coordinator, given.process_id)
    if place is not None and getattr(given, "out", None) is None:
        raise InputError("several processes meet beside their run's folder; name one that all hosts see, by --out")
    return place


def in_processes(work: Callable[[Arguments], None], given: Arguments, place: Place, limits: Limits) -> int:
    """Does `work` in all processes of a command, and gives the exit status; errors as `processes.start`."""
    of_all: Any = given
    out = of_all.out.absolute()
    here = {"processes": place.processes, "coordinator": place.coordinator, "process_id": place.process}
    if place.process:
        here |= {name: False for name in SEEN_BY_USERS if hasattr(given, name)}
    resumable = hasattr(given, "resume") and getattr(given, "continues", True)
    arguments = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in dataclasses.asdict(of_all).items()
        if key not in (*here, *SEEN_BY_USERS, "out")
    }
    # What is left there by a child that was ended goes with its parent.
    with tempfile.TemporaryDirectory(prefix="dln_jax-") as left:

        def work_here() -> None:
            tempfile.tempdir = left
            work(dataclasses.replace(of_all, **here))

        return processes.start(
            work_here,
            place,
            out.with_name(f"{out.name}.processes"),
            arguments,
            devices=of_all.devices,
            remedy="continue with --resume in all" if resumable else "start them again",
            limits=limits,
        )


def is_first(given: Any) -> bool:
    """Whether this process is the one that writes."""
    return not getattr(given, "process_id", None)


def wait_for_all(given: Any) -> None:
    """Waits until all processes are here."""
    if (getattr(given, "processes", None) or 1) > 1:
        processes.wait_for_all(mesh_of(given))


@contextlib.contextmanager
def copied_folder(given: Any, resume: bool) -> Iterator[Path]:
    """Yields a folder of this process alone, which is then removed, with a copy of the run to be continued."""
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
