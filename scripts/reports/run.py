"""One run of a report: measures its cases, stores each as it ends, resumes, prints tables and writes report.json."""

import importlib
import inspect
import math
import os
import sys
import time
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, make_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import tyro

from dln_jax.files import as_type, is_file, read_json, write_bytes, write_json
from dln_jax.metrics.report import Row, conditions, write_report
from dln_jax.options import Resumable
from dln_jax.precision import in_float64
from dln_jax.runs.arguments import names_listed
from dln_jax.runs.folder import command_folder
from dln_jax.runs.running import run
from dln_jax.types import InputError

JOBS = "jobs.json"
REMEDY = "restore the file, or delete it to measure everything again"
UNITS = {
    "seconds": "s",
    "milliseconds": "ms",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
    "mrad": "mrad",
    "rad": "rad",
    "per_second": "1/s",
    "m": "m",
    "bytes": "B",
    "metres": "m",
    "mm": "mm",
    "torque_mse": "N^2 m^2",
    "mib": "MiB",
}
"""Units by the words in a quantity's name; all others are numbers without a unit."""

Numbers = Mapping[str, Mapping[str, float]]
"""Measured numbers by case of a row and quantity."""
Stored = dict[str, dict[str, float | None]]
"""The same in a file, where `None` is a number that is not finite."""
NAMES = tuple[str, ...]
KINDS: dict[Any, Any] = {kind: kind for kind in (int, float, str, Path)}
KINDS |= {kind | None: kind for kind in KINDS} | {NAMES: str}
"""Types of a function's keyword that is an option, and of the option: names have commas between them."""


class AtLeast(NamedTuple):
    """A bound from below; a plain number bounds from above."""

    number: float


class Case(NamedTuple):
    """A measurement, and the numbers that its results stand beside."""

    name: str
    """SUBJECT/NAME, stable and lower case."""
    function: Callable[..., Numbers]
    """Its keywords are options of the report's command line; one that is `None` by default takes text or a path."""
    settings: Mapping[str, Any] = {}
    """Keywords of the function that no option changes."""
    quick: Mapping[str, Any] = {}
    """Keywords of the function with --quick."""
    published: Mapping[str, float] = {}
    """Reference values by "QUANTITY", for all rows, or by "ROW QUANTITY"."""
    bound: Mapping[str, float | AtLeast] = {}
    """Numbers to reach, by the same keys."""
    by_name_only: bool = False
    """Whether the case is measured only if --only names it, such as one that needs other simulators."""


def report(name: str) -> None:
    """Runs the command line of a report, a module of `scripts.reports.cases`; a first word without dashes is --only."""
    # Factorisations here are small, and OpenBLAS's threads wait for each other by spinning.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = sys.argv[1:]
    if words and not words[0].startswith("-"):
        words.insert(0, "--only")
    module = importlib.import_module(f"scripts.reports.cases.{name}")
    sys.argv[0] = f"python -m scripts.report {name}"  # reports state the command that made them
    run(
        lambda options: measure_report(name, module.CASES, options),
        arguments_of(module.CASES),
        prog=sys.argv[0],
        line=words,
        description=module.__doc__,
        began=time.perf_counter(),
    )


def keywords_of(case: Case) -> dict[str, Any]:
    """Types of the keywords of a case's function that are options."""
    function = case.function
    while isinstance(function, partial):
        function = function.func
    hints = typing.get_type_hints(function)
    names = inspect.signature(case.function).parameters
    return {name: hints[name] for name in names if name not in case.settings and hints.get(name) in KINDS}


def arguments_of(cases: Sequence[Case]) -> type:
    """The options of a report: those of every run, and the keywords of its functions."""
    subjects = ",".join(dict.fromkeys(case.name.split("/")[0] for case in cases))
    options: dict[str, tuple[Any, str]] = {
        "only": (str, f"Subjects, or whole names of cases, comma separated: {subjects} (default: all)."),
        "quick": (bool, "Less of everything, to try the command."),
    }
    for case in cases:
        for name, hint in keywords_of(case).items():
            default = inspect.signature(case.function).parameters[name].default
            text = f"Of {case.name.split('/')[0]} (default: {'none' if default is None else default})."
            options.setdefault(name, (KINDS[hint], text))
    fields: list[Any] = [("MEASURES_COMPILATION", ClassVar[bool], True)]
    for name, (kind, text) in options.items():
        empty, kind = (False, bool) if kind is bool else (None, kind | None)
        shown = Annotated[kind, tyro.conf.arg(help=text, help_behavior_hint="")]
        fields.append((name, shown, field(default=empty)))
    return make_dataclass("Arguments", fields, bases=(Resumable,), frozen=True)


def measure_report(name: str, cases: Sequence[Case], options: Any) -> None:
    """Measures the chosen cases into the folder of the run, with a line for each, and publishes all rows."""
    chosen = chosen_cases(cases, names_listed(options.only))
    with command_folder(options, name) as folder:
        stored = stored_numbers(folder, chosen) if options.resume else {}
        for number, case in enumerate(chosen, start=1):
            began = time.perf_counter()
            if case.name not in stored:
                numbers = in_float64(case.function)(**settings_of(case, options))
                stored[case.name] = {
                    row: {name: float(value) for name, value in of.items()} for row, of in numbers.items()
                }
                write_json(folder / JOBS, stored)
            rows = rows_of(case, stored[case.name])
            judged = [row.passed for row in rows if row.passed is not None]
            passed = f"{sum(judged)}/{len(judged)} pass  " if judged else ""
            seconds = time.perf_counter() - began
            print(f"{number:2d}/{len(chosen)}  {case.name:30s} {passed}{seconds:.1f} s", flush=True)
        rows = [row for case in chosen for row in rows_of(case, stored[case.name])]
        publish(folder, rows, conditions(report=name, dtype="float64", quick=options.quick))


def chosen_cases(cases: Sequence[Case], names: Sequence[str]) -> list[Case]:
    """The cases of some subjects, or with these names; all but those that must be named, if there are no names.

    Raises:
        InputError: a name is neither that of a subject nor that of a case.
    """
    known = {case.name: {case.name, case.name.split("/")[0]} for case in cases}
    subjects = dict.fromkeys(name.split("/")[0] for name in known)
    for name in names:
        if not any(name in words for words in known.values()):
            raise InputError(
                f"--only: '{name}' is unknown; choose from {', '.join(subjects)}, or a case of one of them"
            )
    if not names:
        return [case for case in cases if not case.by_name_only]
    return [case for case in cases if known[case.name] & set(names)]


def settings_of(case: Case, options: Any) -> dict[str, Any]:
    """The keywords of a case's function: those that the user stated, before those of --quick and of the table."""
    stated = {}
    for name, hint in keywords_of(case).items():
        if (value := getattr(options, name)) is not None:
            stated[name] = names_listed(value) if hint == NAMES else value
    return {**case.settings, **(case.quick if options.quick else {}), **stated}


def rows_of(case: Case, numbers: Stored) -> list[Row]:
    """Rows of a report: numbers with their units, beside the published ones and the bounds; a null is NaN."""
    rows = []
    for name, values in numbers.items():
        for quantity, value in values.items():
            keys = f"{name} {quantity}", quantity
            reference = next((case.published[key] for key in keys if key in case.published), None)
            bound = next((case.bound[key] for key in keys if key in case.bound), None)
            at_least = isinstance(bound, AtLeast)
            number = bound.number if at_least else bound
            value = math.nan if value is None else value
            rows.append(Row(name, quantity, value, unit_of(quantity), reference, number, at_least))
    return rows


def unit_of(quantity: str) -> str:
    """Unit of a quantity: that of the first words in its name that have one, else 1."""
    return next((unit for words, unit in UNITS.items() if f"_{words}_" in f"_{quantity}_"), "1")


def stored_numbers(folder: Path, cases: Sequence[Case]) -> dict[str, Stored]:
    """The numbers of these cases in a folder's jobs.json; empty if there is none.

    Raises:
        InputError: the file is damaged.
    """
    path = folder / JOBS
    values = read_json(path, remedy=REMEDY) if is_file(path) else {}
    read = as_type(values, dict[str, Stored], name=str(path), remedy=REMEDY)
    if unknown := set(read) - {case.name for case in cases}:
        raise InputError(f"{path}: {unknown.pop()!r:.60} is not a case of this run; {REMEDY}")
    return read


def publish(folder: Path, rows: Sequence[Row], facts: Mapping[str, Any]) -> None:
    """Writes report.json and table.md, and prints the table and the rows that miss their bounds."""
    write_report(folder / "report.json", rows, facts)
    write_bytes(folder / "table.md", markdown(rows).encode())
    print(markdown(rows))
    print("; ".join((facts["machine"], facts["dtype"], f"{facts['threads']} threads", facts["command"])))
    judged = [row for row in rows if row.passed is not None]
    failing = [f"{row.case} {row.quantity}" for row in judged if not row.passed]
    if judged:
        print(f"{len(judged) - len(failing)} of {len(judged)} pass", *(f"fails: {name}" for name in failing), sep="\n")
    print(f"report: {folder / 'report.json'}")


def markdown(rows: Sequence[Row]) -> str:
    """A line per number: case, quantity, value, and what stands beside it."""
    lines = [["case", "quantity", "value", "unit", "reference", "to reach", "pass"], ["---"] * 7]
    for row in rows:
        reference = "" if row.reference is None else f"{row.reference:.3g}"
        reach = "" if row.bound is None else f"{'≥' if row.at_least else '≤'} {row.bound:.3g}"
        passed = {True: "yes", False: "no", None: ""}[row.passed]
        lines.append([row.case, row.quantity, f"{row.value:.3g}", row.unit, reference, reach, passed])
    kept = [column for column in zip(*lines, strict=True) if any(column[2:])]
    return "".join(f"| {' | '.join(line)} |\n" for line in zip(*kept, strict=True))
