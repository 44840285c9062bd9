"""Hard cases: what is measured, what theory expects, and whether it is met."""

import functools
from collections.abc import Callable

from dln_jax.precision import in_float64
from dln_jax.studies.case import Case, Findings
from dln_jax.studies.stability.close_encounters import close_encounters
from dln_jax.studies.stability.conditioning import mass_conditions, sizes
from dln_jax.studies.stability.data_faults import batches, not_finite, torque_channels
from dln_jax.studies.stability.double_pendulum import lyapunov_time
from dln_jax.studies.stability.figures import FIGURES
from dln_jax.studies.stability.indefinite import indefinite_hessians
from dln_jax.studies.stability.noise import missing_friction, noise
from dln_jax.studies.stability.rounding import activations, single_precision, turned_angles
from dln_jax.studies.stability.separatrix import separatrix
from dln_jax.types import require_positive

__all__ = ["NAMES", "cases"]

SHORT: dict[str, Callable[[], Findings]] = {
    "activations": activations,
    "turned-angles": turned_angles,
    "float32": single_precision,
    "mass-conditions": mass_conditions,
    "sizes": sizes,
    "indefinite-hessians": indefinite_hessians,
    "close-encounters": close_encounters,
    "torque-channels": torque_channels,
    "batches": batches,
    "not-finite": not_finite,
    "noise": noise,
    "missing-friction": missing_friction,
}
LONG: dict[str, Callable[[int], Findings]] = {"separatrix": separatrix, "lyapunov-time": lyapunov_time}
"""Those whose length is a choice."""
NAMES = (*SHORT, *LONG)


def cases(*, steps: int = 100_000) -> list[Case]:
    """All hard cases, in float64; `steps` is the length of long motions, `InputError` for none."""
    require_positive(steps=steps)
    measures = {**SHORT, **{name: functools.partial(measure, steps) for name, measure in LONG.items()}}
    return [Case(name, in_float64(measure), draw=FIGURES.get(name)) for name, measure in measures.items()]
