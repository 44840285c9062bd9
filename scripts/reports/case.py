"""Cases, the named measurements of a report, and the loop that measures, stores and publishes them."""

import math
import reprlib
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.cli.stored_arguments import command_folder
from dln_jax.files import is_file, read_json, write_json
from dln_jax.types import InputError
from scripts.reports.rows import Row, conditions, publish

JOBS = "jobs.json"
REMEDY = "restore the file, or delete it to measure everything again"


class Findings(NamedTuple):
    """Results of a case: rows of a report."""

    rows: list[Row]


class Case(NamedTuple):
    """A measurement: its name, its function and the quantities it must return."""

    name: str
    """Stable, lower case."""
    measure: Callable[[], Findings]
    quantities: Mapping[str, Collection[str]] = {}
    """Required quantities by case of the rows; stored results are checked against them."""


class Done(NamedTuple):
    """A measured case, for the progress report."""

    place: str
    """Number of the case and number of cases, such as "3/14"."""
    case: Case
    findings: Findings
    seconds: float


def measure(
    cases: Sequence[Case], report: Callable[[Done], None], *, folder: Path | None = None, resume: bool = False
) -> dict[str, Findings]:
    """Measures the cases one after the other and calls `report` after every case.

    Returns the findings by name, in the order of the cases. After every case, jobs.json in `folder` stores all findings
    so far (of rows: case, quantity and value). With `resume`, stored cases are not measured again.
    """
    results = stored_findings(folder, cases) if folder and resume else {}
    for number, case in enumerate(cases, start=1):
        began = time.perf_counter()
        if case.name not in results:
            results[case.name] = case.measure()
            if folder:
                stored = {name: {"rows": [row[:3] for row in done.rows]} for name, done in results.items()}
                write_json(folder / JOBS, stored)
        place = f"{number:{len(str(len(cases)))}d}/{len(cases)}"
        report(Done(place, case, results[case.name], time.perf_counter() - began))
    return {case.name: results[case.name] for case in cases}


def report_cases(options: Any, command: str, cases: Sequence[Case], **facts: Any) -> None:
    """Body of a command: measures cases into its folder, with a line for each, and publishes all rows.

    `facts`, and `quick` of the options, become conditions of the report.
    """
    with command_folder(options, command) as folder:

        def show(done: Done) -> None:
            bound = [row.passed for row in done.findings.rows if row.passed is not None]
            passed = f"{sum(bound)}/{len(bound)} pass  " if bound else ""
            missed = "".join(f"  {one.quantity} {one.value:.4g}" for one in done.findings.rows if one.passed is False)
            print(f"{done.place}  {done.case.name:30s} {passed}{done.seconds:.1f} s{missed}", flush=True)

        quick = {"quick": options.quick} if hasattr(options, "quick") else {}
        publish(folder, rows_in(measure(cases, show)), conditions(**facts, **quick))


def rows_in(results: Mapping[str, Findings]) -> list[Row]:
    """All rows of the findings."""
    return [row for findings in results.values() for row in findings.rows]


def say_numbers(*shown: str) -> Callable[[Done], None]:
    """Returns a `report` for `measure` that prints the `shown` quantities, one line per case of the rows."""

    def report(done: Done) -> None:
        for case, numbers in by_case(done.findings.rows).items():
            line = "  ".join(f"{key} {numbers[key]:.3g}" for key in shown if key in numbers)
            print(f"{done.place}  {case:44s} {line}", flush=True)

    return report


def named(cases: Sequence[Case], *names: str) -> list[Case]:
    """Selects cases by name; `InputError` for an unknown name."""
    known = {case.name: case for case in cases}
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"case '{unknown[0]}' is unknown; choose from {', '.join(known)}")
    return [known[name] for name in names]


def in_subjects(cases: Sequence[Case], subjects: Sequence[str]) -> list[Case]:
    """The cases of some subjects, in the order of the subjects; a case's name begins with that of its subject."""
    return [case for subject in subjects for case in cases if case.name.split("/")[0] == subject]


def by_case(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The numbers of rows by case and quantity."""
    numbers: dict[str, dict[str, float]] = {}
    for row in rows:
        numbers.setdefault(row.case, {})[row.quantity] = row.value
    return numbers


def rows_of(case: str, numbers: Mapping[str, float]) -> list[Row]:
    """Converts numbers by quantity to rows without unit, reference or bound, which a table adds later."""
    return [Row(case, quantity, value) for quantity, value in numbers.items()]


def spread(case: str, quantity: str, values: Any, unit: str = "1", **more: Any) -> list[Row]:
    """Rows QUANTITY_median and QUANTITY_worst (the largest) of some values; `more` are other fields of the rows."""
    statistics = {"median": np.median, "worst": np.max}
    return [Row(case, f"{quantity}_{name}", float(of(values)), unit, **more) for name, of in statistics.items()]


def stored_findings(folder: Path, cases: Sequence[Case]) -> dict[str, Findings]:
    """Reads the findings of these cases from a folder's jobs.json; empty if there is no file. Null values become NaN.

    Raises:
        InputError: the file is damaged, or another release wrote it.
    """
    path, known = folder / JOBS, {case.name: case for case in cases}
    results = {}
    for name, values in (read_json(path, remedy=REMEDY) if is_file(path) else {}).items():
        if name not in known:
            raise InputError(f"{path}: {name!r:.60} is not a case of this table; {REMEDY}")
        results[name] = _from_json(f"{path}: {name}", values)
        numbers = by_case(results[name].rows)
        if others := [case for case in numbers if case not in known[name].quantities]:
            raise InputError(f"{path}: {others[0]!r:.60} is not a case of {name}; {REMEDY}")
        for case, quantities in known[name].quantities.items():
            if missing := [quantity for quantity in quantities if quantity not in numbers.get(case, {})]:
                raise InputError(f"{path}: {case} lacks {missing[0]}; {REMEDY}")
    return results


def _from_json(place: str, values: Any) -> Findings:
    def number(value: Any) -> float:
        return math.nan if value is None else value + 0.0

    try:
        return Findings([Row(case, quantity, number(value)) for case, quantity, value in values["rows"]])
    except (AttributeError, KeyError, TypeError, ValueError):
        expected = "rows of case, quantity and number"
        raise InputError(f"{place} holds {reprlib.repr(values)}; expected {expected}; {REMEDY}") from None
