"""Measure the hard cases: numerical stability, each number beside what theory lets one expect.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), and writes report.json. All of it
is float64 unless a case says otherwise.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.precision import in_float64
from dln_jax.types import require_positive
from scripts.reports.case import Case, named, report_cases
from scripts.reports.stability.conditioning import indefinite_hessians, mass_conditions, sizes
from scripts.reports.stability.data_faults import batches, not_finite, torque_channels
from scripts.reports.stability.double_pendulum import lyapunov_time
from scripts.reports.stability.encounters import close_encounters, separatrix
from scripts.reports.stability.noise import missing_friction, noise
from scripts.reports.stability.rounding import float32, turned_angles

SHORT = (
    *(turned_angles, float32, mass_conditions, sizes, indefinite_hessians, close_encounters),
    *(torque_channels, batches, not_finite, noise, missing_friction),
)
LONG = (separatrix, lyapunov_time)
"""Cases of selectable length."""
NAMES = tuple(measure.__name__.replace("_", "-") for measure in (*SHORT, *LONG))


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(NAMES, several=True)] = ",".join(NAMES)
    """Hard cases (default: all)."""
    steps: int = 100_000
    """Number of steps of the long motions: the separatrix and the double pendulum."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    chosen = named(cases(steps=options.steps), *names_in("--only", options.only, NAMES))
    dtype = "float64, and float32 where a case says so"
    report_cases(options, "stability", chosen, dtype=dtype, seeds=[0], steps=options.steps)


def cases(*, steps: int = 100_000) -> list[Case]:
    """All hard cases, in float64; `steps` is the length of long motions; `InputError` unless it is positive."""
    require_positive(steps=steps)
    measures = (*SHORT, *(partial(measure, steps) for measure in LONG))
    return [Case(name, in_float64(measure)) for name, measure in zip(NAMES, measures, strict=True)]
