"""Hard cases by name: what is measured, what theory expects, and whether it is met."""

from collections.abc import Callable

from dln_jax.precision import in_float64
from dln_jax.studies.case import Case, Findings
from dln_jax.studies.stability.close_encounters import close_encounters
from dln_jax.studies.stability.conditioning import mass_conditions, sizes
from dln_jax.studies.stability.data_faults import batches, not_finite, torque_channels
from dln_jax.studies.stability.double_pendulum import lyapunov_time
from dln_jax.studies.stability.indefinite import indefinite_hessians
from dln_jax.studies.stability.noise import missing_friction, noise
from dln_jax.studies.stability.rounding import activations, single_precision, turned_angles
from dln_jax.studies.stability.separatrix import separatrix
from dln_jax.types import InputError, require_positive

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

__all__ = ["LONG", "NAMES", "SHORT", "Case", "Findings", "measure"]


@in_float64
def measure(name: str, *, steps: int = 100_000) -> Findings:
    """The cases of one subject; `steps` is the length of long motions.

    Raises:
        InputError: no such subject, or no steps.
    """
    require_positive(steps=steps)
    if name in LONG:
        return LONG[name](steps)
    if name not in SHORT:
        raise InputError(f"hard case '{name}' is unknown; choose from {', '.join(NAMES)}")
    return SHORT[name]()
