"""Measure soft bodies: closed forms, hard cases, gradients and speed, each number beside what one may expect.

Prints one table (case, quantity, expected, got, bound, unit, pass), writes report.json, and draws figures. All of it is
float64 unless a case says otherwise.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from dln_jax.command_line.arguments import Unstated, choice, names_in
from dln_jax.command_line.running import stored_arguments
from dln_jax.files import CONFIG, run_folder, write_figure, write_json
from dln_jax.studies.case import Case
from dln_jax.studies.case_report import write_and_print
from dln_jax.studies.report import conditions
from dln_jax.studies.soft_bodies import SUBJECTS, measure
from dln_jax.studies.soft_bodies.figures import FIGURES


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    quick: bool = False
    """Smaller meshes, fewer and shorter motions: 90 s instead of minutes."""
    out: Unstated[Path] = None
    """Folder for report.json and the figures (default: runs/softbody-1, -2, ...)."""
    figures: bool = True
    """Draw the figures."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", given.only, SUBJECTS)
    with run_folder(given.out, "softbody") as folder:
        measure_into(folder, given, subjects)


def measure_into(folder: Path, given: Arguments, subjects: list[str]) -> None:
    """Measures the subjects, and writes and prints their table."""
    write_json(folder / CONFIG, stored_arguments(given))
    console = Console(highlight=False, soft_wrap=True)
    wanted = [(subject, name) for subject in subjects for name in SUBJECTS[subject]]
    cases: list[Case] = []
    for number, (subject, name) in enumerate(wanted, start=1):
        began = time.perf_counter()
        found = measure(subject, name, quick=given.quick)
        cases += found.cases
        if given.figures and name in FIGURES:
            write_figure(folder / f"{name}.png", FIGURES[name](found.curves))
        passed = sum(case.passed for case in found.cases)
        seconds = time.perf_counter() - began
        console.print(
            f"{number:2d}/{len(wanted)}  {subject:10s} {name:20s} {passed}/{len(found.cases)} pass  {seconds:.1f} s"
        )
    facts = conditions(
        dtype="float64, and float32 where a case says so",
        seeds=[0],
        quick=given.quick,
        expected={f"{case.name} {case.quantity}": case.expected for case in cases},
    )
    write_and_print(folder, cases, facts)
