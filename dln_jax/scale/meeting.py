"""Processes find each other in a folder before they are one program, and agree that they are the same one."""

import errno
import importlib.metadata
import json
import socket
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dln_jax.scale.places import Place, address
from dln_jax.scale.signs import Limits, Peer, Sign, looked_at, require_own, write
from dln_jax.types import InputError

ABSENT = "nothing"
PATIENCE = 5.0
"""s, after which a user is told who is waited for."""


def versions() -> dict[str, str]:
    """Of what must be the same in all processes: other versions compile other programs."""
    packages = {name: importlib.metadata.version(name) for name in ("dln-jax", "jax", "jaxlib")}
    return packages | {"python": f"{sys.version_info.major}.{sys.version_info.minor}"}


def facts(place: Place, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """In which processes must agree, as JSON values; of `arguments`, those that decide what is computed."""
    of_all = {"--processes": place.processes, "--coordinator": place.coordinator}
    options = {f"--{key.replace('_', '-')}": value for key, value in arguments.items()}
    return json.loads(json.dumps({**versions(), **of_all, **options}))


def meet(folder: Path, place: Place, own: Sign, limits: Limits) -> Sign:
    """Waits until all processes are there, compares them, and gives this one's next sign.

    Process 0 looks at all others, which look at it alone.

    Raises:
        InputError: one does not come, or has refused to, or they do not agree, or process 0's port is taken.
    """
    others = peers_of(place)
    since = last = time.monotonic()
    asked = False
    while True:
        require_own(folder, place.process, own.token)
        own = own._replace(beat=own.beat + 1)
        write(folder, place.process, own)
        time.sleep(limits.beat / 2)
        now = time.monotonic()
        others = {k: looked_at(peer, folder, k, min(now - last, 2 * limits.beat)) for k, peer in others.items()}
        last = now
        for k, peer in others.items():
            if peer.present and peer.sign is not None:
                _require_same(place, k, own, peer.sign)
        here = {k for k, peer in others.items() if peer.present}
        if place.process == 0 and len(here) == len(others):
            require_port(place.coordinator)
            own = own._replace(stage="met")
            write(folder, 0, own)
            return own
        if place.process > 0 and here and (sign := others[0].sign) and sign.stage != "meeting":
            return own._replace(stage="met")
        if now - since > limits.meeting:
            raise InputError(_absent(place, others, here, folder, limits))
        if not asked and now - since > PATIENCE and place.process == 0:
            print(f"waiting for {_named(others.keys() - here)} of {place.processes}", file=sys.stderr, flush=True)
            asked = True


def peers_of(place: Place) -> dict[int, Peer]:
    """The processes that one looks at: process 0 at all others, and these at process 0, which says what it sees."""
    return {k: Peer() for k in (range(1, place.processes) if place.process == 0 else (0,))}


def require_port(coordinator: str) -> None:
    """Raises `InputError` unless a service can be opened at the port of this host."""
    port = address(coordinator)[1]
    kinds = [(socket.AF_INET6, "::"), (socket.AF_INET, "")] if socket.has_ipv6 else [(socket.AF_INET, "")]
    for kind, everywhere in kinds:
        try:
            with socket.socket(kind) as tried:
                # Not the port of a program that has ended: that of one that listens.
                tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tried.bind((everywhere, port))
                tried.listen()
        except OSError as error:
            if error.errno in (errno.EADDRINUSE, errno.EACCES):
                raise InputError(
                    f"port {port} of --coordinator is not free here ({error.strerror}); give another"
                ) from None


def _require_same(place: Place, k: int, own: Sign, sign: Sign) -> None:
    """Raises `InputError` that names the first thing in which two processes differ, or why the other has refused."""
    if sign.stage in ("ended", "over"):
        raise InputError(sign.said if k == 0 else f"process {k} on {sign.host}: {sign.said}")
    for name in sorted(own.facts.keys() | sign.facts.keys()):
        mine, other = own.facts.get(name, ABSENT), sign.facts.get(name, ABSENT)
        if mine != other:
            pair = sorted([(place.process, mine), (k, other)])
            text = " and ".join(f"{value!r:.60} in process {process}" for process, value in pair)
            raise InputError(f"{name} is {text}; all processes need the same command and the same versions")


def _absent(place: Place, others: dict[int, Peer], here: Iterable[int], folder: Path, limits: Limits) -> str:
    missing = _named(others.keys() - set(here))
    return (
        f"{missing} of {place.processes} did not come within {limits.meeting:g} s; start the same command for each, "
        f"with --process-id 0 to {place.processes - 1} and an --out that all hosts see (they meet in {folder})"
    )


def _named(processes: Iterable[int]) -> str:
    first, *more = sorted(processes)
    return f"process {first}" if not more else f"processes {', '.join(map(str, (first, *more[:7])))}"
