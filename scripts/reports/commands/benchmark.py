"""Measure speed against error: a report and a table for each subject.

Subjects: one-step (microseconds of single calls against test error, for every model and call path), throughput (batched
states per second), scaling (cost against the number of joints), integrators (steps per second against energy drift and
trajectory error), c (exported C: warm and cold calls, calls from Python, Jacobians, and Pinocchio where it is
installed), casadi (a Runge-Kutta step of the two-link arm with A and B, in our C and in CasADi's), and all of them.
Compilation is timed apart, results are waited for, inputs vary, programs that are compared take turns, and medians
count.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from dln_jax.cli.arguments import Unstated
from dln_jax.cli.options import Folder
from dln_jax.files import write_bytes
from dln_jax.types import InputError
from dln_jax.zoo.run_folder import run_folder
from scripts.reports.case import Case, Done, Findings, measure
from scripts.reports.rows import Row, conditions, markdown, publish
from scripts.reports.speed import casadi_in_c, costs, exported_c, integrators, one_step

SUBJECTS: dict[str, Callable[..., Findings]] = {
    "one-step": one_step.measure,
    "throughput": costs.measure_throughput,
    "scaling": costs.measure_scaling,
    "integrators": integrators.measure,
    "c": exported_c.measure,
    "casadi": casadi_in_c.measure,
}
"""Functions quick -> findings, by subject."""


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure, and for how long."""

    subject: tyro.conf.Positional[Literal["one-step", "throughput", "scaling", "integrators", "c", "casadi", "all"]] = (
        "all"
    )
    """Subject of the measurements."""
    quick: bool = False
    """Fewer cases and repetitions: a look at whether everything runs, in two minutes."""
    against: Unstated[Path] = None
    """With subject c: folder of the same models' exports by another release, which take turns with these (default:
    these alone)."""


def main(options: Arguments) -> None:
    """Measures, prints and writes; finished subjects are kept even if a later one is interrupted."""
    if options.against and options.subject != "c":
        raise InputError(f"--against is for subject c; {options.subject} does not use it")
    every = cases(quick=options.quick, c={"against": options.against})
    published: list[Row] = []
    with run_folder(options.out, "benchmark") as folder:

        def keep(done: Done) -> None:
            rows = done.findings.rows
            published.extend(rows)
            write_bytes(folder / f"{done.case.name}.md", markdown(rows).encode())
            facts = conditions(
                dtype="float32 unless said", seeds=[0], call_path="default jit unless said", quick=options.quick
            )
            publish(folder, published, facts, shown=[row for row in rows if row.bound is not None] or rows[:40])

        measure([case for case in every if options.subject in (case.name, "all")], keep)


def cases(*, quick: bool = False, **more: Mapping[str, Any]) -> list[Case]:
    """All subjects; their rows are named SUBJECT/..., and quick ones have fewer of them and fewer repetitions.

    `more` are further keywords of the functions that measure, by subject.
    """

    def measured(name: str) -> Findings:
        findings = SUBJECTS[name](quick, **more.get(name, {}))
        return findings._replace(rows=[row._replace(case=f"{name}/{row.case}") for row in findings.rows])

    return [Case(name, partial(measured, name)) for name in SUBJECTS]
