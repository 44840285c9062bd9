"""Measure whether models know what they do not know: coverage of 95 % bands on held-out motions, and flags.

Rigid trees of simulated arms, with the friction that they have and with friction that they lack; structured networks of
the embedded letters, exact and noisy; and recordings of a real arm and a real double pendulum where they are given.
Prints a table, medians over splits and the worst, and writes report.json.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from dln_jax.cli.arguments import Unstated, names_in
from dln_jax.cli.options import Folder
from dln_jax.types import InputError, require_positive
from dln_jax.zoo.run_folder import run_folder
from scripts.reports.case import measure_and_publish, named
from scripts.reports.uncertainty.cases import cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure on."""

    MEASURES_COMPILATION: ClassVar = False

    cases: Unstated[str] = None
    """Names of cases, comma separated (default: all)."""
    splits: int = 5
    """Of each case; every one of the recordings' and letters' holds out other motions."""
    steps: int = 150
    """Iterations of Gauss-Newton for a network."""
    ur10: Unstated[Path] = None
    """Recording of an UR10: t, q, tau and joint_names."""
    double_pendulum: Unstated[Path] = None
    """Recordings of a double pendulum: t, q, tau and trajectory."""


def main(given: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(splits=given.splits, steps=given.steps)
    for path in (given.ur10, given.double_pendulum):
        if path is not None and not path.is_file():
            raise InputError(f"{path}: no such file; expected an npz of a recording")
    every = cases(
        splits=given.splits, recorded_arm=given.ur10, recorded_pendulum=given.double_pendulum, steps=given.steps
    )
    if given.cases is not None:
        every = named(every, *names_in("--cases", given.cases, [case.name for case in every]))
    with run_folder(given.out, "uncertainty_report") as folder:
        measure_and_publish(folder, every, dtype="float64")
