"""Writes report.json: one number per row with its reference or bound, and the conditions of the measurement."""

import datetime
import importlib.metadata
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from dln_jax.files import write_json

PACKAGES = ("dln-jax", "jax", "jaxlib", "dm-haiku", "optax", "numpy", "diffrax")


class Row(NamedTuple):
    """One measured number; names are stable and lower case, so that runs can be compared."""

    case: str
    quantity: str
    value: float
    unit: str = "1"
    reference: float | None = None
    """Published or closed-form value."""
    bound: float | None = None
    at_least: bool = False
    """Whether the bound is a lower bound."""
    expected: str = ""
    """The expected result and the origin of the bound, in words."""

    @property
    def passed(self) -> bool | None:
        """Whether the bound is met (NaN does not meet it); `None` without a bound."""
        if self.bound is None:
            return None
        return bool(self.value >= self.bound if self.at_least else self.value <= self.bound)


def conditions(**facts: Any) -> dict[str, Any]:
    """Returns machine, versions, threads, command, date and all keywords (dtype, seeds, ...)."""
    return {
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}",
        "device": str(jax.devices()[0]),
        "versions": {"python": platform.python_version(), **{p: importlib.metadata.version(p) for p in PACKAGES}},
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "command": " ".join(sys.argv),
        "date": datetime.date.today().isoformat(),
        **facts,
    }


def write_report(path: Path, rows: Sequence[Row], facts: Mapping[str, Any]) -> None:
    """Writes the conditions, with the expectations of rows, and the rows as JSON; infinities and NaN become null."""
    listed = [{**dict(zip(Row._fields[:6], row, strict=False)), "pass": row.passed} for row in rows]
    words = {f"{row.case} {row.quantity}": row.expected for row in rows if row.expected}
    write_json(path, {"conditions": {**facts, **({"expected": words} if words else {})}, "rows": listed})


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown processor"
