"""Measure the hard cases: numerical stability, each number beside what theory lets one expect.

Prints one table (case, expected, got, pass), writes report.json, and draws figures. All of it is float64 unless a case
says otherwise.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from dln_jax.command_line.arguments import Unstated, choice, names_in
from dln_jax.command_line.running import stored_arguments
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.studies.case_report import write_and_print
from dln_jax.studies.report import conditions
from dln_jax.studies.stability import NAMES, Case, measure
from dln_jax.studies.stability.figures import FIGURES
from dln_jax.types import require_positive


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    only: Annotated[str, choice(NAMES, several=True)] = ",".join(NAMES)
    """Hard cases (default: all)."""
    steps: int = 100_000
    """Of the long motions: the separatrix and the double pendulum."""
    out: Unstated[Path] = None
    """Folder for report.json and the figures (default: runs/stability-1, -2, ...)."""
    figures: bool = True
    """Draw the figures."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(steps=given.steps)
    names = names_in("--only", given.only, NAMES)
    with run_folder(given.out, "stability") as folder:
        measure_into(folder, given, names)


def measure_into(folder: Path, given: Arguments, names: list[str]) -> None:
    """Measures the cases, and writes and prints their table."""
    write_json(folder / CONFIG, stored_arguments(given))
    console = Console(highlight=False, soft_wrap=True)
    cases: list[Case] = []
    for number, name in enumerate(names, start=1):
        began = time.perf_counter()
        found = measure(name, steps=given.steps)
        cases += found.cases
        if given.figures and name in FIGURES:
            write_figure(folder / f"{name}.png", FIGURES[name](found.curves))
        passed = sum(case.passed for case in found.cases)
        seconds = time.perf_counter() - began
        console.print(f"{number}/{len(names)}  {name:20s} {passed}/{len(found.cases)} pass  {seconds:.1f} s")
    facts = conditions(
        dtype="float64, and float32 where a case says so",
        seeds=[0],
        steps=given.steps,
        expected={f"{case.name} {case.quantity}": case.expected for case in cases},
    )
    write_and_print(folder, cases, facts)
