"""Measure the structured DeLaN against the published implementation: errors, training time, one-step latency.

It trains with the published protocol (64x64 tanh, batch 512, 20,000 steps, float32, test letters e, q, v) on
--data, by default the embedded letters, and checks the generic mechanics against the closed form of the arm.
Prints a table and writes report.json with one number per row. It is one split: `arm_table` measures others.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from dln_jax.command_line.arguments import Unstated
from dln_jax.command_line.options import Folder
from dln_jax.data.splits import split
from dln_jax.datasets.default_data import CHARACTERS_TEST
from dln_jax.studies.arm.published_protocol import cases
from dln_jax.studies.arm.table import letters
from dln_jax.studies.case import measure_and_publish
from dln_jax.types import require_positive
from dln_jax.zoo.run_folder import run_folder


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure on."""

    MEASURES_COMPILATION: ClassVar = True

    data: Unstated[Path] = None
    """Trajectories of the two-link arm in the npz schema (default: the embedded letters)."""
    test: str = ",".join(CHARACTERS_TEST)
    """Labels of the test trajectories, comma separated."""
    seeds: int = 1
    """How many seeds to train, from 0 upwards; each also draws its own validation letters."""
    steps: int = 20_000
    """Optimiser steps."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(seeds=given.seeds, steps=given.steps)
    data, name = letters(given.data), "embedded-letters" if given.data is None else given.data.stem
    sets = [split(data, test=given.test.split(","), seed=seed) for seed in range(given.seeds)]
    with run_folder(given.out, "delan_report") as folder:
        chosen, seeds = cases(name, sets, steps=given.steps), list(range(given.seeds))
        measure_and_publish(folder, chosen, dtype="float32; textbook float64", seeds=seeds, call_path="default jit")
