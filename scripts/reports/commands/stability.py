"""Measure the hard cases: numerical stability, each number beside what theory lets one expect.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), writes report.json, and draws
figures. All of it is float64 unless a case says otherwise.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.stored_arguments import command_folder
from scripts.reports.case import measure_and_publish, named
from scripts.reports.stability import NAMES, cases


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to measure."""

    only: Annotated[str, choice(NAMES, several=True)] = ",".join(NAMES)
    """Hard cases (default: all)."""
    steps: int = 100_000
    """Of the long motions: the separatrix and the double pendulum."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    chosen = named(cases(steps=given.steps), *names_in("--only", given.only, NAMES))
    with command_folder(given, "stability") as folder:
        facts = {"dtype": "float64, and float32 where a case says so", "seeds": [0], "steps": given.steps}
        measure_and_publish(folder, chosen, figures=given.figures, **facts)
