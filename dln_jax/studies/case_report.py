"""Cases of a report: written as report.json, and shown as one table with what fails below it."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dln_jax.studies.case import Case
from dln_jax.studies.report import write_report


def write_and_print(folder: Path, cases: Sequence[Case], facts: dict[str, Any]) -> None:
    """Writes report.json into the folder and prints the table."""
    console = Console(highlight=False, soft_wrap=True)
    write_report(folder / "report.json", [case.row for case in cases], facts)
    # A file or a pipe has no width to keep to.
    Console(highlight=False, width=None if sys.stdout.isatty() else 200).print(table(cases))
    failing = [f"{case.name} {case.quantity}" for case in cases if not case.passed]
    console.print(f"{len(cases) - len(failing)} of {len(cases)} pass" + "".join(f"\nfails: {name}" for name in failing))
    console.print(f"report: {folder / 'report.json'}")


def table(cases: Sequence[Case]) -> Table:
    """One line per case."""
    shown = Table("case", "quantity", "expected", "got", "bound", "unit", "pass")
    for case in cases:
        sign = "≥" if case.at_least else "≤"
        passed = "yes" if case.passed else "[bold red]no[/]"
        numbers = (f"{case.got:.3g}", f"{sign} {case.bound:.3g}", case.unit)
        shown.add_row(case.name, case.quantity, case.expected, *numbers, passed)
    return shown
