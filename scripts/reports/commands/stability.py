"""Measure the prediction horizon of a chaotic double pendulum, each number beside what theory lets one expect.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), and writes report.json, in float64.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.precision import in_float64
from dln_jax.types import require_positive
from scripts.reports.case import Case, named, report_cases
from scripts.reports.stability.double_pendulum import lyapunov_time

NAMES = ("lyapunov-time",)


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(NAMES, several=True)] = ",".join(NAMES)
    """Cases (default: all)."""
    steps: int = 100_000
    """Number of steps of the motions."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    chosen = named(cases(steps=options.steps), *names_in("--only", options.only, NAMES))
    report_cases(options, "stability", chosen, dtype="float64", seeds=[0], steps=options.steps)


def cases(*, steps: int = 100_000) -> list[Case]:
    """All cases, in float64; `steps` is the length of the motions; `InputError` unless it is positive."""
    require_positive(steps=steps)
    return [Case(NAMES[0], in_float64(partial(lyapunov_time, steps)))]
