"""Measure robots: identification, tracking, learned kinematics, real logs and speed, beside rivals in the same run.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), writes report.json, and draws
figures. Rivals are measured where they are installed: pip install 'dln-jax[reference]'.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.command_line.arguments import choice, names_in
from dln_jax.command_line.options import Drawn, Folder
from dln_jax.command_line.running import command_folder
from dln_jax.studies.case import measure_and_publish
from dln_jax.studies.robots import MEASURES, cases


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to measure."""

    only: Annotated[str, choice(MEASURES, several=True)] = ",".join(MEASURES)
    """Subjects (default: all)."""
    quick: bool = False
    """Fewer seeds and motions."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", given.only, MEASURES)
    chosen = [case for each in subjects for case in cases(quick=given.quick) if case.name.startswith(f"{each}/")]
    with command_folder(given, "robots") as folder:
        measure_and_publish(folder, chosen, figures=given.figures, dtype="float64", quick=given.quick)
