"""Measure speed against error: one report, a table and a figure for each subject.

Subjects: one-step (microseconds of single calls against test error, for every model and call path), throughput (batched
states per second), scaling (cost against the number of joints), training (error against seconds), integrators (steps
per second against energy drift and trajectory error), precision (float32 against float64), softbody (steps per second
of soft bodies, their gradients and time steps), and all of them. Compilation is timed apart, results are waited for,
inputs vary, programs that are compared take turns, and medians count.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from matplotlib.figure import Figure
from rich.console import Console

from dln_jax.command_line.arguments import Unstated
from dln_jax.files import run_folder, write_bytes, write_figure
from dln_jax.studies.report import Row, conditions, markdown, write_report
from dln_jax.studies.report_table import print_report
from dln_jax.studies.speed import integrators as benchmark_integrators
from dln_jax.studies.speed import one_step as benchmark_one_step
from dln_jax.studies.speed import precision as benchmark_precision
from dln_jax.studies.speed import scaling as benchmark_scaling
from dln_jax.studies.speed import soft_bodies as benchmark_softbody
from dln_jax.studies.speed import throughput as benchmark_throughput
from dln_jax.studies.speed import training as benchmark_training

Measure = Callable[[bool], tuple[list[Row], Figure]]
MEASURES: dict[str, Measure] = {
    "one-step": benchmark_one_step.measure,
    "throughput": benchmark_throughput.measure,
    "scaling": benchmark_scaling.measure,
    "training": benchmark_training.measure,
    "integrators": benchmark_integrators.measure,
    "precision": benchmark_precision.measure,
    "softbody": benchmark_softbody.measure,
}


@dataclass(frozen=True)
class Arguments:
    """What to measure, and for how long."""

    subject: tyro.conf.Positional[
        Literal["one-step", "throughput", "scaling", "training", "integrators", "precision", "softbody", "all"]
    ] = "all"
    """What is measured."""
    quick: bool = False
    """Fewer cases and repetitions: a look at whether everything runs, in two minutes."""
    out: Unstated[Path] = None
    """Folder for report.json, a Markdown table and a figure of each subject (default: runs/benchmark-1, -2, ...)."""


def main(given: Arguments) -> None:
    """Measures, prints and writes; what is measured is kept even if a later subject is interrupted."""
    with run_folder(given.out, "benchmark") as folder:
        measure_into(folder, given)


def measure_into(folder: Path, given: Arguments) -> None:
    """Measures the subjects, prints their tables, and writes what each gives as soon as it does."""
    console = Console(highlight=False, soft_wrap=True)
    subjects = MEASURES if given.subject == "all" else {given.subject: MEASURES[given.subject]}
    facts = functools.partial(
        conditions, dtype="float32 unless said", seeds=[0], call_path="default jit unless said", quick=given.quick
    )
    every: list[Row] = []
    for name, measure in subjects.items():
        console.print(f"{name} ...")
        rows, figure = measure(given.quick)
        rows = [row._replace(case=f"{name}/{row.case}") for row in rows]
        every += rows
        write_figure(folder / f"{name}.png", figure)
        write_bytes(folder / f"{name}.md", markdown(rows).encode())
        write_report(folder / "report.json", every, facts())
        print_report([row for row in rows if row.bound is not None] or rows[:40], facts())
    print(f"report: {folder / 'report.json'}; tables and figures of {', '.join(subjects)} beside it")
