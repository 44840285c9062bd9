"""A report as a table for the terminal."""

import sys
from typing import Any

from rich.console import Console
from rich.table import Table

from dln_jax.studies.report import Row


def print_report(rows: list[Row], facts: dict[str, Any]) -> None:
    """Prints the table; a file or a pipe has no width to keep to."""
    width = None if sys.stdout.isatty() else 160
    Console(highlight=False, width=width).print(report_table(rows, facts))


def report_table(rows: list[Row], facts: dict[str, Any]) -> Table:
    """One line per row; the caption states the conditions."""
    caption = f"{facts['machine']}; {facts['dtype']}; {facts['threads']} threads; {facts['command']}"
    table = Table("case", "quantity", "value", "unit", "reference", "to reach", "pass", caption=caption)
    for row in rows:
        sign = "≥" if row.at_least else "≤"
        bound = "" if row.bound is None else f"{sign} {row.bound:.3g}"
        reference = "" if row.reference is None else f"{row.reference:.3g}"
        passed = {True: "yes", False: "[bold red]no[/]", None: ""}[row.passed]
        table.add_row(row.case, row.quantity, f"{row.value:.3g}", row.unit, reference, bound, passed)
    return table
