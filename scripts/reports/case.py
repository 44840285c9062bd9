"""Cases: what a report measures, by name, and the one loop that measures them and keeps what has been measured."""

import math
import reprlib
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard

from matplotlib.figure import Figure

from dln_jax.files import is_file, matches, read_json, write_figure, write_json
from dln_jax.metrics.report import Row, conditions, publish
from dln_jax.types import InputError

JOBS = "jobs.json"
REMEDY = "restore the file, or delete it to measure everything again"


class Findings(NamedTuple):
    """What was measured: the rows of a report, and the curves that a figure draws of them."""

    rows: list[Row]
    curves: dict[str, Any] = {}  # noqa: RUF012  never written to


class Case(NamedTuple):
    """A measurement: its name, what measures it, what must come of it, and how it is drawn."""

    name: str
    """Stable, lower case."""
    measure: Callable[[], Findings]
    quantities: Mapping[str, Collection[str]] = {}
    """By case of the rows, the quantities that there must be of it; what is stored is held against them."""
    draw: Callable[[dict[str, Any]], Figure] | None = None
    """A figure of the curves."""


class Done(NamedTuple):
    """A case that has been measured, while others are to come."""

    place: str
    """Its number and how many there are, as "3/14"."""
    case: Case
    findings: Findings
    seconds: float


def measure(
    cases: Sequence[Case],
    report: Callable[[Done], None],
    *,
    folder: Path | None = None,
    resume: bool = False,
) -> dict[str, Findings]:
    """Measures the cases one after the other, and tells `report` of each.

    Returns the findings by name, in the order of the cases. The jobs.json of a `folder` keeps what is there after each
    case; of rows that is case, quantity and value. With `resume`, what it has is not measured again.
    """
    found = stored_findings(folder, cases) if folder and resume else {}
    for number, case in enumerate(cases, start=1):
        began = time.perf_counter()
        if case.name not in found:
            found[case.name] = case.measure()
            if folder:
                kept = {
                    name: {"rows": [row[:3] for row in rows], "curves": each} for name, (rows, each) in found.items()
                }
                write_json(folder / JOBS, kept)
        place = f"{number:{len(str(len(cases)))}d}/{len(cases)}"
        report(Done(place, case, found[case.name], time.perf_counter() - began))
    return {case.name: found[case.name] for case in cases}


def measure_and_publish(folder: Path, cases: Sequence[Case], *, figures: bool = True, **facts: Any) -> None:
    """Measures cases with a line and a figure of each, and publishes all rows with `facts` among the conditions."""

    def say(done: Done) -> None:
        bound = [row.passed for row in done.findings.rows if row.passed is not None]
        passed = f"{sum(bound)}/{len(bound)} pass  " if bound else ""
        print(f"{done.place}  {done.case.name:30s} {passed}{done.seconds:.1f} s", flush=True)
        if figures:
            draw(folder, done.case, done.findings)

    publish(folder, rows_in(measure(cases, say)), conditions(**facts))


def rows_in(found: Mapping[str, Findings]) -> list[Row]:
    """All rows of what was measured."""
    return [row for findings in found.values() for row in findings.rows]


def say_numbers(*shown: str) -> Callable[[Done], None]:
    """What prints, for `measure`, a line of the most telling numbers of each case of the rows."""

    def report(done: Done) -> None:
        for case, numbers in by_case(done.findings.rows).items():
            line = "  ".join(f"{key} {numbers[key]:.3g}" for key in shown if key in numbers)
            print(f"{done.place}  {case:44s} {line}", flush=True)

    return report


def named(cases: Sequence[Case], *names: str) -> list[Case]:
    """Some of the cases, by their names; `InputError` for one that there is not."""
    known = {case.name: case for case in cases}
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"case '{unknown[0]}' is unknown; choose from {', '.join(known)}")
    return [known[name] for name in names]


def draw(folder: Path, case: Case, findings: Findings) -> None:
    """Writes the figure of a case, if it has one, under the last part of its name."""
    if case.draw is not None and findings.curves:
        write_figure(folder / f"{case.name.split('/')[-1]}.png", case.draw(findings.curves))


def by_case(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """The numbers of rows by case and quantity."""
    found: dict[str, dict[str, float]] = {}
    for row in rows:
        found.setdefault(row.case, {})[row.quantity] = row.value
    return found


def rows_of(case: str, numbers: Mapping[str, float]) -> list[Row]:
    """Numbers by quantity as bare rows, of which a table says later what they are compared with."""
    return [Row(case, quantity, value) for quantity, value in numbers.items()]


def stored_findings(folder: Path, cases: Sequence[Case]) -> dict[str, Findings]:
    """What a folder's jobs.json has of some cases, none where there is no file; what JSON cannot say is NaN.

    Raises:
        InputError: the file is damaged, or another release has written it.
    """
    path, known = folder / JOBS, {case.name: case for case in cases}
    found = {}
    for name, values in (read_json(path, remedy=REMEDY) if is_file(path) else {}).items():
        if name not in known:
            raise InputError(f"{path}: {name!r:.60} is no case of this table; {REMEDY}")
        found[name] = _from_json(f"{path}: {name}", values)
        numbers = by_case(found[name].rows)
        if others := [case for case in numbers if case not in known[name].quantities]:
            raise InputError(f"{path}: {others[0]!r:.60} is no case of {name}; {REMEDY}")
        for case, quantities in known[name].quantities.items():
            if missing := [quantity for quantity in quantities if quantity not in numbers.get(case, {})]:
                raise InputError(f"{path}: {case} lacks {missing[0]}; {REMEDY}")
    return found


def _from_json(place: str, values: Any) -> Findings:
    rows, curves = (values.get(key) for key in ("rows", "curves")) if isinstance(values, dict) else (None, None)
    if not _lists(rows) or not all(len(row) == 3 and all(map(matches, row, (str, str, float | None))) for row in rows):
        raise InputError(f"{place} holds {reprlib.repr(values)}; expected rows of case, quantity, number; {REMEDY}")
    if not isinstance(curves, dict) or not _lists(points := list(curves.values())):
        raise InputError(f"{place} has no curves; {REMEDY}")
    if not all(matches(x, float | None) for each in points for x in each):
        raise InputError(f"{place} has a curve that is none; {REMEDY}")
    number = lambda value: math.nan if value is None else float(value)  # noqa: E731
    curves = {name: list(map(number, each)) for name, each in curves.items()}
    return Findings([Row(case, quantity, number(value)) for case, quantity, value in rows], curves)


def _lists(values: Any) -> TypeGuard[list[list[Any]]]:
    return isinstance(values, list) and all(isinstance(each, list) for each in values)
