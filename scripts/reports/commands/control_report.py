"""Measure controllers: swing-ups, a public board, learned models, value functions, tracking, plans, and C.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), writes report.json, and draws
figures.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.stored_arguments import command_folder
from scripts.reports.case import measure_and_publish
from scripts.reports.control.cases import cases

SUBJECTS = (
    "swing-up", "starts", "board", "learned", "equation", "value", "tracking", "robustness", "laws", "mpc",
)  # fmt: skip


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    quick: bool = False
    """Fewer starts, draws and plans."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", given.only, SUBJECTS)
    chosen = [case for case in cases(quick=given.quick) if case.name.split("/")[0] in subjects]
    with command_folder(given, "control") as folder:
        measure_and_publish(folder, chosen, figures=given.figures, dtype="float64", quick=given.quick)
