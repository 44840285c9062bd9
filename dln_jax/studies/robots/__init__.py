"""What is measured of robots: identification, tracking, learned trees, real logs and speed."""

import functools

from dln_jax.precision import in_float64
from dln_jax.studies.case import Case
from dln_jax.studies.robots import known_kinematics, speed

MEASURES = {
    "arm": {"clean": known_kinematics.clean, "noisy": known_kinematics.noisy},
    "speed": {"seven-axis": speed.speed},
}
"""quick -> findings, by subject and by name; only `speed` depends on the machine."""


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64; quick ones have fewer seeds and shorter motions."""
    return [
        Case(f"{subject}/{name}", in_float64(functools.partial(measure, quick)))
        for subject, measures in MEASURES.items()
        for name, measure in measures.items()
    ]
