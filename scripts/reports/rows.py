"""Rows of reports and their tables, printed and in Markdown."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, SupportsFloat

import numpy as np
from rich.console import Console
from rich.table import Table

from dln_jax.metrics.report import Row, conditions, write_report

__all__ = [
    "REPORT",
    "UNITS",
    "Row",
    "conditions",
    "expect",
    "largest",
    "markdown",
    "print_report",
    "publish",
    "report_table",
    "unit_of",
    "write_report",
]

REPORT = "report.json"
WIDTH, NARROWEST = 200, 132
"""Width of a table in a file or a pipe, and its smallest width in a terminal."""
UNITS = {"seconds": "s", "us": "us", "j": "J"}
"""SI units by the words in a quantity's name."""


def expect(
    case: str,
    quantity: str,
    expected: str,
    value: SupportsFloat,
    bound: SupportsFloat,
    unit: str = "1",
    *,
    at_least: bool = False,
    reference: float | None = None,
) -> Row:
    """Returns the row of a number with an expectation from theory: `expected`, and the resulting `bound`."""
    return Row(case, quantity, float(value), unit, reference, float(bound), at_least, expected)


def largest(values: Any) -> float:
    """The largest of some numbers; NaN if one is NaN, so that it meets no bound."""
    return float(np.max(np.asarray(values, np.float64)))


def unit_of(quantity: str, units: Mapping[str, str] = UNITS) -> str:
    """SI unit of a quantity: that of the first key whose words its name contains, else 1."""
    return next((unit for words, unit in units.items() if f"_{words}_" in f"_{quantity}_"), "1")


def publish(
    folder: Path,
    rows: Sequence[Row],
    facts: Mapping[str, Any],
    *,
    shown: Sequence[Row] | None = None,
    tables: Sequence[Table | str] = (),
) -> None:
    """Writes report.json into a folder; prints a table of its rows (or of `shown`), other tables, and failing rows."""
    write_report(folder / REPORT, rows, facts)
    print_report(rows if shown is None else shown, facts, *tables)
    bound = [row for row in rows if row.passed is not None]
    failing = [f"{row.case} {row.quantity}" for row in bound if not row.passed]
    if bound:
        print(f"{len(bound) - len(failing)} of {len(bound)} pass", *(f"fails: {name}" for name in failing), sep="\n")
    print(f"report: {folder / REPORT}")


def print_report(rows: Sequence[Row], facts: Mapping[str, Any], *others: Table | str) -> None:
    """Prints the table of some rows, followed by other tables."""
    console = Console(highlight=False, soft_wrap=True)
    # Truncated numbers are useless, so that a narrow terminal gets long lines.
    console.width = max(console.width, NARROWEST) if sys.stdout.isatty() else WIDTH
    for table in (report_table(rows, facts), *others):
        print(table) if isinstance(table, str) else console.print(table)


def report_table(rows: Sequence[Row], facts: Mapping[str, Any]) -> Table:
    """Returns a table with one line per row, without empty columns; the caption states the conditions."""
    passed = {True: "yes", False: "[bold red]no[/]", None: ""}
    to_reach = ["" if row.bound is None else f"{'≥' if row.at_least else '≤'} {row.bound:.3g}" for row in rows]
    columns = {
        **{name: [getattr(row, name) for row in rows] for name in ("case", "quantity", "expected")},
        "value": [f"{row.value:.3g}" for row in rows],
        "unit": [row.unit for row in rows],
        "reference": ["" if row.reference is None else f"{row.reference:.3g}" for row in rows],
        "to reach": to_reach,
        "pass": [passed[row.passed] for row in rows],
    }
    columns = {name: cells for name, cells in columns.items() if any(cells)}
    caption = "; ".join((facts["machine"], facts["dtype"], f"{facts['threads']} threads", facts["command"]))
    table = Table(*columns, caption=caption)
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*cells)
    return table


def markdown(rows: Sequence[Row]) -> str:
    """Markdown table with a line per case and a column per quantity: "ours", or "ours / reference" if there is one."""
    columns = list(dict.fromkeys((row.quantity, row.unit) for row in rows))
    titles = [quantity.replace("_", " ") + (f", {unit}" if unit != "1" else "") for quantity, unit in columns]
    lines: dict[str, dict[tuple[str, str], str]] = {}
    for row in rows:
        numbers = [row.value] if row.reference is None else [row.value, row.reference]
        cell = " / ".join(f"{number:.3g}" for number in numbers)
        lines.setdefault(row.case, {})[row.quantity, row.unit] = cell
    table = [["case", *titles], ["---"] * (1 + len(titles))]
    table += [[case, *(cells.get(column, "") for column in columns)] for case, cells in lines.items()]
    return "".join(f"| {' | '.join(line)} |\n" for line in table)
