"""Reports: one number per row, with what it is compared to and the conditions it was measured under."""

import datetime
import importlib.metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax

from dln_jax.files import write_json

PACKAGES = ("dln-jax", "jax", "jaxlib", "dm-haiku", "optax", "numpy", "diffrax")


class Row(NamedTuple):
    """One measured number; names are stable, lower case, so that anyone can compare two runs."""

    case: str
    quantity: str
    value: float
    unit: str
    reference: float | None = None
    """Published or closed-form value."""
    bound: float | None = None
    """Figure to reach."""
    at_least: bool = False
    """Whether the bound is a lower one."""

    @property
    def passed(self) -> bool | None:
        """Whether the bound is met; `None` without one."""
        if self.bound is None:
            return None
        return self.value >= self.bound if self.at_least else self.value <= self.bound


def conditions(**given: Any) -> dict[str, Any]:
    """Machine, versions, threads, command and date, and whatever else is given (dtype, seeds, ...)."""
    return {
        "machine": f"{_processor()}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}",
        "device": str(jax.devices()[0]),
        "versions": {"python": platform.python_version(), **{p: importlib.metadata.version(p) for p in PACKAGES}},
        "threads": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "command": " ".join(["python", "-m", _module_name(), *sys.argv[1:]]),
        "date": datetime.date.today().isoformat(),
        **given,
    }


def write_report(path: Path, rows: list[Row], facts: dict[str, Any]) -> None:
    """Writes `{"conditions": ..., "rows": [...]}` as JSON; a value that is not finite becomes null."""
    listed = [
        {
            "case": row.case,
            "quantity": row.quantity,
            "value": row.value,
            "unit": row.unit,
            "reference": row.reference,
            "bound": row.bound,
            "pass": row.passed,
        }
        for row in rows
    ]
    write_json(path, {"conditions": facts, "rows": listed})


def markdown(rows: list[Row]) -> str:
    """A table with a line per case and a column per quantity, in the order in which they come."""
    cases = list(dict.fromkeys(row.case for row in rows))
    columns = list(dict.fromkeys((row.quantity, row.unit) for row in rows))
    values = {(row.case, row.quantity, row.unit): f"{row.value:.3g}" for row in rows}
    titles = [quantity.replace("_", " ") + (f", {unit}" if unit != "1" else "") for quantity, unit in columns]
    lines = [["case", *titles], ["---"] * (len(columns) + 1)]
    lines += [[case, *(values.get((case, *column), "") for column in columns)] for case in cases]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _module_name() -> str:
    specification = getattr(sys.modules.get("__main__"), "__spec__", None)
    return specification.name if specification else Path(sys.argv[0]).name


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown processor"
