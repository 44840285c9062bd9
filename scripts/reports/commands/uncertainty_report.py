"""Measure whether models know what they do not know: coverage of 95 % bands on held-out motions, and flags.

Rigid trees of simulated arms, with the friction that they have and with friction that they lack; structured networks of
the embedded letters, exact and noisy; and recordings of a real arm and a real double pendulum where they are given.
Prints a table, medians over splits and the worst, and writes report.json.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.cli.arguments import Unstated, names_in
from dln_jax.cli.options import Folder
from dln_jax.types import InputError, require_positive
from scripts.reports.case import named, report_cases
from scripts.reports.uncertainty.cases import cases


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure on."""

    cases: Unstated[str] = None
    """Names of cases, comma separated (default: all)."""
    splits: int = 5
    """Number of splits of each case; every split of recordings and letters holds out other motions."""
    steps: int = 150
    """Iterations of Gauss-Newton for a network."""
    ur10: Unstated[Path] = None
    """Recording of an UR10: t, q, tau and joint_names."""
    double_pendulum: Unstated[Path] = None
    """Recordings of a double pendulum: t, q, tau and trajectory."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(splits=options.splits, steps=options.steps)
    for path in (options.ur10, options.double_pendulum):
        if path is not None and not path.is_file():
            raise InputError(f"{path}: no such file; expected an npz of a recording")
    chosen = cases(
        splits=options.splits, steps=options.steps, recorded_arm=options.ur10, recorded_pendulum=options.double_pendulum
    )
    if options.cases is not None:
        chosen = named(chosen, *names_in("--cases", options.cases, [case.name for case in chosen]))
    report_cases(options, "uncertainty_report", chosen, dtype="float64")
