"""Soft bodies by subject: what is measured, what theory expects, and whether it is met."""

from collections.abc import Callable

from dln_jax.precision import in_float64
from dln_jax.studies.case import Findings
from dln_jax.studies.soft_bodies import gradients, motions, robustness, sliding, speed, statics
from dln_jax.types import InputError

Measurement = Callable[[bool], Findings]
"""quick -> findings; a quick measurement is smaller."""

SUBJECTS: dict[str, dict[str, Measurement]] = {
    "references": {
        "free-fall": motions.free_fall,
        "invariants": motions.invariants,
        "oscillator": motions.oscillator,
        "orders": motions.orders,
        "block": sliding.block,
        "slope": sliding.slope,
        "uniaxial": statics.uniaxial,
        "patch-test": statics.patch_test,
        "elastica": statics.elastica,
        "cantilever": statics.cantilever,
    },
    "hard": {
        "time-steps": robustness.time_steps,
        "materials": robustness.materials,
        "bad-starts": robustness.bad_starts,
        "mass-ratio": robustness.mass_ratio,
        "chain": robustness.chain,
        "twist": robustness.twist,
        "float32": robustness.single_precision,
        "not-converged": robustness.not_converged,
    },
    "gradients": {
        "crawler": gradients.creature,
        "coulomb": gradients.coulomb,
        "modes": gradients.modes,
    },
    "speed": {
        "creature": speed.creature,
        "beams": speed.beams,
        "backward": speed.backward,
        "linear-solvers": speed.linear_solvers,
        "speed-against-error": speed.speed_against_error,
    },
}
"""By subject and by name. Only `speed` depends on the machine."""

__all__ = ["SUBJECTS", "measure"]


@in_float64
def measure(subject: str, name: str, *, quick: bool = False) -> Findings:
    """The cases of one measurement.

    Raises:
        InputError: no such subject or measurement.
    """
    if subject not in SUBJECTS:
        raise InputError(f"subject '{subject}' is unknown; choose from {', '.join(SUBJECTS)}")
    if name not in SUBJECTS[subject]:
        raise InputError(f"{subject} has no '{name}'; choose from {', '.join(SUBJECTS[subject])}")
    found = SUBJECTS[subject][name](quick)
    # NumPy's scalars compare to NumPy's booleans.
    return found._replace(cases=[case._replace(got=float(case.got), bound=float(case.bound)) for case in found.cases])
