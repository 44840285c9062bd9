"""Results of a sweep: all jobs with their metrics, medians over seeds, and the best job, chosen by validation alone."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from dln_jax.commands.sweeps.job import METRICS, Job, Status, status_of
from dln_jax.figures.sweeps import Point, error_against_seconds
from dln_jax.files import as_type, finite, is_file, read_json, write_bytes, write_json
from dln_jax.types import InputError

VALIDATION = ("validation_error", "validation_loss", "validation")
ERRORS = ("torque_mse", "value_mse", "rollout_mse", "torque_nmse", "down_return_mean")
SECONDS = ("train_seconds", "learning_seconds", "identify_seconds")
"""Names of metrics in the commands; of every group the first name that the jobs have counts."""
PROBLEM = (
    "creature", "data", "function", "goal", "lock", "needs", "objective", "plant", "robot", "scene", "task", "test",
)  # fmt: skip
"""Options that define a problem; errors of different problems are not compared."""
WIDTH = 200
"""Width of tables in columns. A narrow terminal wraps their lines, since truncated numbers would be useless."""
MOST_ROWS = 200
MOST_PANELS = 6
"""Largest number of problems drawn in panels of their own."""


class Entry(NamedTuple):
    """A job, its status and its metrics."""

    job: Job
    status: Status
    metrics: dict[str, Any]

    def number(self, name: str | None) -> float | None:
        """A metric; `None` if the job lacks it or it is not finite."""
        value = self.metrics.get(name) if name else None
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


class Group(NamedTuple):
    """Jobs that differ only in the options that medians are taken over."""

    values: dict[str, str]
    done: int
    jobs: int
    medians: dict[str, float]
    worst: dict[str, float]


class Results(NamedTuple):
    """All jobs of a sweep, compared. A metric's name is `None` if no job has such a metric."""

    entries: list[Entry]
    metrics: list[str]
    validation: str | None
    error: str | None
    seconds: str | None
    best: list[Entry]
    """The job with the best validation for every problem with several jobs; test errors are ignored."""
    over: tuple[str, ...]
    """Options that medians are taken over."""
    groups: list[Group]

    @property
    def shown(self) -> list[str]:
        """The metrics in the tables."""
        return [name for name in (self.validation, self.error, self.seconds) if name]


def compared(
    jobs: Sequence[Job],
    over: Sequence[str] = (),
    *,
    metric: str | None = None,
    error: str | None = None,
    largest: bool = False,
) -> Results:
    """Compares all jobs.

    Args:
        over: options that medians are taken over.
        metric: metric that chooses the best job; default: the first of `VALIDATION` that jobs have.
        error: metric that is shown beside it; default: the first of `ERRORS`.

    Raises:
        InputError: jobs have metrics, but none has the requested one.
    """
    entries = [_entry(job) for job in jobs]
    metrics = list(dict.fromkeys(name for entry in entries for name in entry.metrics))
    for option, name in (("metric", metric), ("error", error)):
        if metrics and name is not None and name not in metrics:
            raise InputError(
                f"--{option}: no job has the metric {name!r:.40}; choose from {', '.join(sorted(metrics))}. Jobs that "
                f"are done are kept: --resume with another --{option} only makes the table"
            )
    usual = [next((name for name in names if name in metrics), None) for names in (VALIDATION, ERRORS, SECONDS)]
    names = (metric or usual[0], error or usual[1], usual[2])
    choose = max if largest else min
    best = []
    for rivals in _classes([entry for entry in entries if entry.number(names[0]) is not None], problem_of):
        if len(rivals) > 1:
            best.append(choose(rivals, key=lambda entry: entry.number(names[0]) or 0.0))
    groups = []
    for part in _classes(entries, lambda values: [(name, text) for name, text in values.items() if name not in over]):
        numbers = {name: [n for entry in part if (n := entry.number(name)) is not None] for name in names if name}
        numbers = {name: values for name, values in numbers.items() if values}
        medians = {name: float(np.median(values)) for name, values in numbers.items()}
        worst = {name: (min if largest and name == names[0] else max)(values) for name, values in numbers.items()}
        values = {name: text for name, text in part[0].job.values.items() if name not in over}
        groups.append(Group(values, sum(entry.status.state == "done" for entry in part), len(part), medians, worst))
    return Results(entries, metrics, *names, best, tuple(over), groups)


def _entry(job: Job) -> Entry:
    """A job with its status, and metrics if it is done; a job with damaged metrics counts as failed."""
    status = status_of(job.folder)
    path = job.folder / status.run / METRICS
    if status.state != "done" or not is_file(path):
        return Entry(job, status, {})
    remedy = "remove the job's folder, and --resume"
    try:
        metrics = as_type(read_json(path, remedy=remedy), dict[str, float | None], name=str(path), remedy=remedy)
        if strange := [name for name in metrics if not name.isidentifier()]:
            raise InputError(f"{path}: {strange[0]!r:.40} is no name of a metric; {remedy}")
        return Entry(job, status, metrics)
    except InputError as error:
        return Entry(job, status._replace(state="failed", line=str(error)), {})


def _classes(entries: Sequence[Entry], key: Any) -> list[list[Entry]]:
    """Jobs with the same key of their values, in the order of the jobs."""
    classes: dict[tuple[Any, ...], list[Entry]] = {}
    for entry in entries:
        classes.setdefault(tuple(key(entry.job.values)), []).append(entry)
    return list(classes.values())


def problem_of(values: Mapping[str, str]) -> tuple[str, ...]:
    """The values of a job that define its problem."""
    return tuple(f"{name} {_short(text)}" for name, text in values.items() if name in PROBLEM)


def print_results(results: Results, command: str, folder: Path) -> None:
    """Prints all jobs, their medians, the best jobs, the jobs that are not done, and the sweep's folder."""
    _print_jobs(results, f"{command}, {len(results.entries)} jobs")
    if results.over:
        _print_groups(results)
    if results.metrics and results.validation not in results.metrics:
        known = ", ".join(sorted(results.metrics))
        print(f"no job has a validation error: none is chosen; --metric takes one of {known}")
    for entry in results.best:
        values = " ".join(f"{name}={text}" for name, text in entry.job.values.items())
        print(f"best by {results.validation}: {values}, run folder {entry.job.folder / entry.status.run}")
    if results.best and results.error in ERRORS:
        print(f"{results.error} is of the test, and took no part in the choice")
    if unfinished := _unfinished(results):
        reasons: dict[str, list[str]] = {}
        for entry in results.entries:
            if entry.status.state != "done":
                reasons.setdefault(f"{entry.status.state}: {entry.status.line}", []).append(entry.job.folder.name)
        print(unfinished, *(f"  {', '.join(names)} {reason}" for reason, names in reasons.items()), sep="\n")
        print(f"--out {folder} --resume does them again")
    print(f"sweep: {folder}")


def _print_jobs(results: Results, title: str) -> None:
    """Prints a line per job; a long sweep shows only the best jobs and the ones that are not done."""
    entries = results.entries
    if len(entries) > MOST_ROWS:
        entries = [entry for entry in entries if entry in results.best or entry.status.state != "done"][:MOST_ROWS]
        title = f"{title} (the best, and those that are not done; all are in table.csv)"
    rows = []
    for entry in entries:
        state = "best" if entry in results.best else entry.status.state
        again = f", attempt {entry.status.attempt}" if entry.status.attempt > 1 else ""
        numbers = {name: entry.number(name) for name in results.shown}
        rows.append({"job": entry.job.folder.name, **entry.job.values, **numbers, "status": state + again})
    _print_rows(title, rows)


def _print_groups(results: Results) -> None:
    rows = []
    for group in results.groups:
        medians = {name: group.medians.get(name) for name in results.shown}
        worst = {f"worst_{name}": group.worst.get(name) for name in results.shown if name != results.seconds}
        rows.append({**group.values, "done": f"{group.done} of {group.jobs}", **medians, **worst})
    _print_rows(f"medians over {', '.join(results.over)}, and the worst", rows)


def _print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    table = Table(title=title)
    for name in rows[0] if rows else ():
        table.add_column(_spaced(name), justify="left" if name == "status" else "right")
    for row in rows:
        table.add_row(*(_short(cell or "") if not isinstance(cell, float) else f"{cell:.3g}" for cell in row.values()))
    Console(highlight=False, soft_wrap=True, width=WIDTH).print(table)


def write_tables(folder: Path, results: Results, **facts: Any) -> None:
    """Writes sweep.json, with `facts` about the sweep, and table.csv with all metrics of every job."""
    text = io.StringIO()
    rows, jobs = csv.writer(text), []
    rows.writerow(["job", *results.entries[0].job.values, "status", "line", "best", "attempts", *results.metrics])
    for entry in results.entries:
        name, values, status, best = entry.job.folder.name, entry.job.values, entry.status, entry in results.best
        numbers = [finite(entry.metrics.get(metric)) for metric in results.metrics]
        texts = map(_cell, (*values.values(), status.state, status.line))
        rows.writerow([name, *texts, int(best), status.attempt, *numbers])
        kinds = {"validation": results.validation, "error": results.error, "train_seconds": results.seconds}
        metrics = {kind: entry.number(metric) for kind, metric in kinds.items()}
        jobs.append({"job": name, "values": values, **status._asdict(), **metrics, "best": best})
    write_bytes(folder / "table.csv", text.getvalue().encode())
    names = {"validation": results.validation, "error": results.error, "seconds": results.seconds}
    groups = [group._asdict() for group in results.groups]
    write_json(folder / "sweep.json", {**facts, "names": names, "jobs": jobs, "groups": groups})


def drawn(results: Results, *, at_once: int | None) -> Figure | None:
    """Draws test error against training time, `at_once` jobs at once; `None` if no job has both."""
    entries, seconds, error = results.entries, results.seconds, results.error
    if seconds is None or error is None:
        return None
    problems = {problem_of(entry.job.values) for entry in entries}
    panels = len(problems) <= MOST_PANELS and len(entries) > len(problems)
    options = entries[0].job.values
    by_look = [name for name in options if name not in (*results.over, *(PROBLEM if panels else ()))]
    colour, marker = (*by_look, "", "")[:2]

    def points(values: Mapping[str, str], x: float | None, y: float | None, **flags: bool) -> list[Point]:
        looks = [_short(values[name]) if name else "" for name in (colour, marker)]
        problem = ", ".join(problem_of(values)) if panels else ""
        return [] if x is None or y is None else [Point(x, y, *looks, problem=problem, **flags)]

    shown = []
    for entry in entries:
        shown += points(entry.job.values, entry.number(seconds), entry.number(error), best=entry in results.best)
    for group in results.groups if set(results.over) & set(options) else ():
        shown += points(group.values, group.medians.get(seconds), group.medians.get(error), median=True)
    if not shown:
        return None
    beside = "" if at_once is None else f", {at_once} jobs at once" if at_once > 1 else ", one job at a time"
    x = f"{seconds.removesuffix('_seconds').replace('train', 'training')}, s{beside}"
    y = "test " * (error in ERRORS) + _spaced(error)
    return error_against_seconds(
        shown, x=x, y=y, colour=_spaced(colour), marker=_spaced(marker), note=_unfinished(results)
    )


def _unfinished(results: Results) -> str:
    """Counts of the jobs that are not done, by state; empty if all are done."""
    states = [entry.status.state for entry in results.entries if entry.status.state != "done"]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    return f"{len(results.entries)} jobs: {counts}" if states else ""


def _cell(text: str) -> str:
    """A text as a cell: a spreadsheet would compute one that starts as a formula and is no number."""
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text
    return text


def _short(text: str) -> str:
    """A value for a table; a path is shortened to its last part."""
    return Path(text).name if "/" in text else text


def _spaced(name: str) -> str:
    return " ".join(word.upper() if word in ("mse", "nmse") else word for word in name.split("_"))
