"""Processes meet at the coordinator's port before JAX joins them, and compare what they were started with."""

import importlib.metadata
import json
import platform
import re
import socket
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

from dln_jax.types import InputError

RECORD_BYTES = 2**16
"""At most, of the options and versions of one process."""
REMEDY = "start the same command once for each --process-id"


class Membership(NamedTuple):
    """How a process joins others; where all is `None`, JAX reads it from the cluster's variables."""

    processes: int | None = None
    coordinator: str | None = None
    """host:port of process 0."""
    process: int | None = None


def address(coordinator: str) -> tuple[str, int]:
    """Host and port; an IPv6 address stands in brackets.

    Raises:
        InputError: the text is no host:port.
    """
    parts = re.fullmatch(r"(\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(\d{1,5})", coordinator)
    if not parts or not 0 < int(parts[2]) < 2**16:
        raise InputError(f"--coordinator is {coordinator!r:.80}; expected host:port, such as node1:61440")
    return parts[1].strip("[]"), int(parts[2])


def meet(member: Membership, options: Mapping[str, Any], seconds: int) -> None:
    """Waits until all processes are there and have the same options and versions.

    Process 0 listens at the coordinator's port, which it leaves to JAX afterwards; the others report to it.

    Raises:
        InputError: in all processes: one does not come, two differ, or the port is taken or out of reach.
    """
    packages = {name: importlib.metadata.version(name) for name in ("dln-jax", "jax", "jaxlib")}
    record = {"Python": platform.python_version(), **packages, "--processes": member.processes, **options}
    record = json.loads(json.dumps(record))  # as the others' come over the line
    until = time.monotonic() + seconds
    if reason := _report(member, record, until) if member.process else _gather(member, record, until):
        raise InputError(reason)


def _gather(member: Membership, record: Mapping[str, Any], until: float) -> str:
    """What process 0 finds wrong, and tells the others; empty if nothing is."""
    port = address(member.coordinator or "")[1]
    family = {"family": socket.AF_INET6, "dualstack_ipv6": True} if socket.has_dualstack_ipv6() else {}
    try:
        server = socket.create_server(("", port), **family)
    except OSError as error:
        return f"port {port} of --coordinator is not free on {socket.gethostname()} ({error.strerror}); choose another"
    expected = set(range(1, member.processes or 1))
    peers: dict[int, socket.socket] = {}
    reason = ""
    with server:
        while expected - peers.keys() and not reason:
            server.settimeout(max(until - time.monotonic(), 0.01))
            try:
                peer, _ = server.accept()
                peer.settimeout(max(until - time.monotonic(), 0.01))
                process, other = json.loads(_line(peer))
            except TimeoutError:
                reason = f"processes {sorted(expected - peers.keys())} of {member.processes} did not come; {REMEDY}"
                break
            except (OSError, ValueError, TypeError):  # somebody else has called
                continue
            reason = f"--process-id {process} is given twice; {REMEDY}" if process in peers else ""
            reason = reason or _difference(record, other, process)
            peers[id(peer) if process in peers else process] = peer
        for peer in peers.values():
            with peer:
                peer.sendall(json.dumps(reason).encode() + b"\n")
    return reason


def _report(member: Membership, record: Mapping[str, Any], until: float) -> str:
    """What process 0 has found wrong."""
    where = address(member.coordinator or "")
    while True:
        try:
            with socket.create_connection(where, timeout=max(until - time.monotonic(), 0.01)) as peer:
                peer.sendall(json.dumps([member.process, record]).encode() + b"\n")
                return json.loads(_line(peer))
        except (OSError, ValueError) as error:
            if isinstance(error, socket.gaierror) or time.monotonic() > until:
                return f"cannot reach {member.coordinator} ({error}); give --coordinator an address of process 0's host"
        time.sleep(0.2)


def _line(peer: socket.socket) -> bytes:
    with peer.makefile("rb") as stream:
        return stream.readline(RECORD_BYTES)


def _difference(record: Mapping[str, Any], other: Mapping[str, Any], process: int) -> str:
    """The first entry in which a process differs from process 0; empty if none does."""
    for name in sorted({*record, *other}):
        if record.get(name) != other.get(name):
            values = f"{record.get(name)!r:.60} in process 0 and {other.get(name)!r:.60} in process {process}"
            return f"{name} is {values}; all processes need the same command and versions"
    return ""
