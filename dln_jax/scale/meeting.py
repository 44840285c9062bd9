"""Lets processes compare options and versions at the coordinator's port before JAX connects them."""

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
"""Largest size of the options and versions that a process sends."""
REMEDY = "start the same command once for each --process-id"


class Membership(NamedTuple):
    """How a process joins others; if all fields are `None`, JAX reads them from the cluster's variables."""

    processes: int | None = None
    coordinator: str | None = None
    """host:port of process 0."""
    process: int | None = None


def address(coordinator: str) -> tuple[str, int]:
    """Returns the host and port of a coordinator; an IPv6 address stands in brackets.

    Raises:
        InputError: the text is no host:port.
    """
    parts = re.fullmatch(r"(\[[0-9a-fA-F:.%\w]+\]|[^\s:\[\]/]+):(\d{1,5})", coordinator)
    if not parts or not 0 < int(parts[2]) < 2**16:
        raise InputError(f"--coordinator is {coordinator!r:.80}; expected host:port, such as node1:61440")
    return parts[1].strip("[]"), int(parts[2])


def meet(member: Membership, options: Mapping[str, Any], seconds: int) -> None:
    """Waits until all processes have arrived with the same options and versions.

    Process 0 listens at the coordinator's port, which JAX uses afterwards; the others report to it.

    Raises:
        InputError: a process is missing, two differ, or the port is taken or unreachable. All processes raise it.
    """
    packages = {name: importlib.metadata.version(name) for name in ("dln-jax", "jax", "jaxlib")}
    record = {"Python": platform.python_version(), **packages, "--processes": member.processes, **options}
    record = json.loads(json.dumps(record))  # the same types as records that were received
    until = time.monotonic() + seconds
    if reason := _report(member, record, until) if member.process else _gather(member, record, until):
        raise InputError(reason)


def _gather(member: Membership, record: Mapping[str, Any], until: float) -> str:
    """Runs process 0's side: returns the reason for a refusal, and sends it to the others; empty if there is none."""
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
            except (OSError, ValueError, TypeError):  # not one of our processes
                continue
            reason = f"--process-id {process} is given twice; {REMEDY}" if process in peers else ""
            reason = reason or _difference(record, other, process)
            peers[id(peer) if process in peers else process] = peer
        for peer in peers.values():
            with peer:
                peer.sendall(json.dumps(reason).encode() + b"\n")
    return reason


def _report(member: Membership, record: Mapping[str, Any], until: float) -> str:
    """Reports to process 0, and returns its reason for a refusal; empty if there is none."""
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
    """Returns the first difference between a process and process 0; empty if there is none."""
    for name in sorted({*record, *other}):
        if record.get(name) != other.get(name):
            values = f"{record.get(name)!r:.60} in process 0 and {other.get(name)!r:.60} in process {process}"
            return f"{name} is {values}; all processes need the same command and versions"
    return ""
