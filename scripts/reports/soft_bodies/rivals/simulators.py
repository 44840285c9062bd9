"""The simulators that can be imported, and rows of what they do."""

import importlib
from types import ModuleType

import numpy as np

from scripts.reports.rows import Row
from scripts.reports.soft_bodies.rivals.body import Body, Run, relative_error

NEEDED = {
    "mujoco_flex": "mujoco",
    "newton_vbd": "newton",
    "newton_explicit": "newton",
    "torch_fem": "torch-fem",
    "tatva_fem": "tatva",
}
"""Modules of this package, and what they need."""


def rivals() -> tuple[dict[str, ModuleType], str]:
    """The rivals that can be imported, and a sentence about those that cannot."""
    simulators, missing = {}, {}
    for name, package in NEEDED.items():
        try:
            simulators[name] = importlib.import_module(f"scripts.reports.soft_bodies.rivals.{name}")
        except ImportError:
            missing[package] = None
    return simulators, f"not installed: {', '.join(missing)} (pip install 'dln-jax[rivals]')" if missing else ""


def findings(name: str, body: Body, runs: dict[str, Run], reference: np.ndarray, missing: str) -> list[Row]:
    """Error and time of runs by SIMULATOR/STEP."""
    rows: list[Row] = []
    for key, run in runs.items():
        error = relative_error(body, run.x, reference)
        case, text = f"{name}/{key}", f"{len(body.mesh.elements)} tetrahedra, {body.law}; {missing}".rstrip("; ")
        rows.append(number(case, "error", text, error))
        rows.append(number(case, "processor_seconds_per_second", text, run.seconds, "s"))
        rows.append(number(case, "compile_seconds", text, run.compiling, "s"))
    return rows


def number(case: str, quantity: str, text: str, value: float, unit: str = "1") -> Row:
    """A row without a bound: rivals are measured, not judged."""
    return Row(f"rivals/{case}", quantity, float(value), unit, None, None, False, text)
