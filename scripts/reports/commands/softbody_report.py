"""Measure soft bodies: closed forms, hard cases, gradients and speed, each number beside what one may expect.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), writes report.json, and draws
figures. All of it is float64 unless a case says otherwise.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.stored_arguments import command_folder
from scripts.reports.case import measure_and_publish
from scripts.reports.soft_bodies import SUBJECTS, cases


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    quick: bool = False
    """Smaller meshes, fewer and shorter motions: 90 s instead of minutes."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", given.only, SUBJECTS)
    chosen = [case for each in subjects for case in cases(quick=given.quick) if case.name.startswith(f"{each}/")]
    with command_folder(given, "softbody") as folder:
        facts = {"dtype": "float64, and float32 where a case says so", "seeds": [0], "quick": given.quick}
        measure_and_publish(folder, chosen, figures=given.figures, **facts)
