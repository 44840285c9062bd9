"""A sweep's results as printed tables, CSV and JSON."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Column, Table

from dln_jax.cli.sweeps.results import Entry, Group, Names, shown
from dln_jax.files import finite, write_bytes, write_json

WIDTH = 200
"""Width of tables in columns. A narrow terminal wraps their lines, since truncated numbers would be useless."""
MOST_ROWS = 200
"""Largest number of rows of a printed table."""


def print_jobs(found: Sequence[Entry], best: Sequence[Entry], names: Names, *, title: str) -> None:
    """Prints a line per job; a long sweep shows only the best jobs and the ones that are not done."""
    listed = found
    if len(found) > MOST_ROWS:
        listed = [entry for entry in found if entry in best or entry.status.state != "done"][:MOST_ROWS]
        title = f"{title} (the best, and those that are not done; all are in table.csv)"
    columns = [*found[0].job.values, *filter(None, names[:3])]
    rows = []
    for entry in listed:
        numbers = [figure(entry.number(name)) for name in filter(None, names[:3])]
        values = [shown(text) for text in entry.job.values.values()]
        rows.append([entry.job.folder.name, *values, *numbers, said(entry, best)])
    print_rows(rows, title=title, columns=["job", *map(spaced, columns), "status"])


def print_groups(of: Sequence[Group], names: Names, over: Sequence[str]) -> None:
    """Prints the median and worst metrics of the groups."""
    listed = [name for name in filter(None, names[:3]) if any(name in group.medians for group in of)]
    judged = [name for name in listed if name != names.seconds]
    titles = [*map(spaced, listed), *(f"worst {spaced(name)}" for name in judged)]
    rows = []
    for group in of:
        numbers = [*(group.medians.get(name) for name in listed), *(group.worst.get(name) for name in judged)]
        rows.append([*map(shown, group.values.values()), f"{group.done} of {group.jobs}", *map(figure, numbers)])
    title = f"medians over {', '.join(over)}, and the worst"
    print_rows(rows, title=title, columns=[*map(spaced, of[0].values), "done", *titles])


def print_rows(rows: Sequence[Sequence[str]], *, title: str, columns: Sequence[str]) -> None:
    """Prints a table."""
    table = Table(*(Column(each, justify="left" if each == "status" else "right") for each in columns), title=title)
    for row in rows:
        table.add_row(*row)
    Console(highlight=False, soft_wrap=True, width=WIDTH).print(table)


def write_tables(
    folder: Path, found: Sequence[Entry], best: Sequence[Entry], of: Sequence[Group], names: Names, **facts: Any
) -> None:
    """Writes sweep.json, and table.csv with all metrics of every job."""
    jobs = [
        {
            "job": entry.job.folder.name,
            "values": entry.job.values,
            **entry.status._asdict(),
            "validation": entry.number(names.validation),
            "error": entry.number(names.error),
            "train_seconds": entry.number(names.seconds),
            "best": entry in best,
        }
        for entry in found
    ]
    write_json(
        folder / "sweep.json",
        {**facts, "names": names._asdict(), "jobs": jobs, "groups": [group._asdict() for group in of]},
    )
    metrics = list(dict.fromkeys(name for entry in found for name in entry.metrics))
    text = io.StringIO()
    lines = csv.writer(text)
    lines.writerow(["job", *found[0].job.values, "status", "line", "best", "attempts", *metrics])
    for entry in found:
        status = entry.status
        own = [status.state, status.line, int(entry in best), status.attempt]
        numbers = [finite(entry.metrics.get(name)) for name in metrics]
        lines.writerow([entry.job.folder.name, *entry.job.values.values(), *own, *numbers])
    write_bytes(folder / "table.csv", text.getvalue().encode())


def said(entry: Entry, best: Sequence[Entry]) -> str:
    """A job's status, with the number of attempts if several."""
    again = f", attempt {entry.status.attempt}" if entry.status.attempt > 1 else ""
    return ("best" if entry in best else entry.status.state) + again


def figure(number: float | None) -> str:
    """Text of a number in a table's cell; empty if it is missing."""
    return "" if number is None else f"{number:.3g}"


def spaced(name: str) -> str:
    """A metric's or option's name as words."""
    return " ".join(word.upper() if word in ("mse", "nmse") else word for word in name.split("_"))
