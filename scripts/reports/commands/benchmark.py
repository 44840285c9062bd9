"""Measure speed against error: one report, a table and a figure for each subject.

Subjects: one-step (microseconds of single calls against test error, for every model and call path), throughput (batched
states per second), scaling (cost against the number of joints), training (error against seconds), integrators (steps
per second against energy drift and trajectory error), precision (float32 against float64), softbody (steps per second
of soft bodies, their gradients and time steps), c (exported C: warm and cold calls, calls from Python, Jacobians, and
Pinocchio where it is installed), and all of them. Compilation is timed apart, results are waited for, inputs vary,
programs that are compared take turns, and medians count.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dln_jax.cli.arguments import Unstated
from dln_jax.cli.options import Folder
from dln_jax.files import write_bytes
from dln_jax.types import InputError
from dln_jax.zoo.run_folder import run_folder
from scripts.reports.case import Done, draw, measure
from scripts.reports.rows import Row, conditions, markdown, publish
from scripts.reports.speed.subjects import cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure, and for how long."""

    subject: tyro.conf.Positional[
        Literal["one-step", "throughput", "scaling", "training", "integrators", "precision", "softbody", "c", "all"]
    ] = "all"
    """What is measured."""
    quick: bool = False
    """Fewer cases and repetitions: a look at whether everything runs, in two minutes."""
    against: Unstated[Path] = None
    """With subject c: folder of the same models' exports by another release, which take turns with these (default:
    these alone)."""


def main(given: Arguments) -> None:
    """Measures, prints and writes; finished subjects are kept even if a later one is interrupted."""
    if given.against and given.subject != "c":
        raise InputError(f"--against is for subject c; {given.subject} does not use it")
    chosen = [
        case for case in cases(quick=given.quick, c={"against": given.against}) if given.subject in (case.name, "all")
    ]
    every: list[Row] = []
    with run_folder(given.out, "benchmark") as folder:

        def keep(done: Done) -> None:
            rows = done.findings.rows
            every.extend(rows)
            draw(folder, done.case, done.findings)
            write_bytes(folder / f"{done.case.name}.md", markdown(rows).encode())
            facts = conditions(
                dtype="float32 unless said", seeds=[0], call_path="default jit unless said", quick=given.quick
            )
            publish(folder, every, facts, shown=[row for row in rows if row.bound is not None] or rows[:40])

        measure(chosen, keep)
