"""Hard cases: measured values compared with theory."""

import functools

from dln_jax.precision import in_float64
from dln_jax.types import require_positive
from scripts.reports.case import Case
from scripts.reports.stability.conditioning import indefinite_hessians, mass_conditions, sizes
from scripts.reports.stability.data_faults import batches, not_finite, torque_channels
from scripts.reports.stability.double_pendulum import lyapunov_time
from scripts.reports.stability.encounters import close_encounters, separatrix
from scripts.reports.stability.figures import FIGURES
from scripts.reports.stability.noise import missing_friction, noise
from scripts.reports.stability.rounding import activations, float32, turned_angles

__all__ = ["NAMES", "cases"]

SHORT = (
    *(activations, turned_angles, float32, mass_conditions, sizes, indefinite_hessians, close_encounters),
    *(torque_channels, batches, not_finite, noise, missing_friction),
)
LONG = (separatrix, lyapunov_time)
"""Cases of selectable length."""
NAMES = tuple(measure.__name__.replace("_", "-") for measure in (*SHORT, *LONG))


def cases(*, steps: int = 100_000) -> list[Case]:
    """All hard cases, in float64; `steps` is the length of long motions; `InputError` unless it is positive."""
    require_positive(steps=steps)
    measures = (*SHORT, *(functools.partial(measure, steps) for measure in LONG))
    named = zip(NAMES, measures, strict=True)
    return [Case(name, in_float64(measure), draw=FIGURES.get(name)) for name, measure in named]
