"""Soft bodies: closed forms, hard cases, gradients and speed, compared with expected values."""

import functools
from collections.abc import Callable

from dln_jax.precision import in_float64
from scripts.reports.case import Case, Findings
from scripts.reports.soft_bodies import choices, gradients, motions, robustness, sliding, speed, statics
from scripts.reports.soft_bodies.figures import FIGURES

__all__ = ["SUBJECTS", "cases"]

MEASURES: dict[str, tuple[Callable[[bool], Findings], ...]] = {
    "references": (
        *(motions.free_fall, motions.invariants, motions.oscillator, motions.orders, sliding.block, sliding.slope),
        *(statics.uniaxial, statics.patch_test, statics.elastica, statics.cantilever),
    ),
    "hard": (
        *(robustness.time_steps, robustness.materials, robustness.bad_starts, robustness.mass_ratio),
        *(robustness.chain, robustness.twist, robustness.float32, robustness.not_converged),
    ),
    "gradients": (gradients.crawler, gradients.coulomb, gradients.modes),
    "speed": (
        speed.creature,
        speed.beams,
        speed.backward,
        speed.linear_solvers,
        speed.speed_against_error,
        choices.solver_choice,
    ),
}
SUBJECTS = {
    subject: {measure.__name__.replace("_", "-"): measure for measure in measures}
    for subject, measures in MEASURES.items()
}
"""Functions quick -> findings, by subject and name; only `speed` depends on the machine."""


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64 unless they say otherwise; quick ones are smaller."""
    return [
        Case(f"{subject}/{name}", in_float64(functools.partial(measure, quick)), draw=FIGURES.get(name))
        for subject, measures in SUBJECTS.items()
        for name, measure in measures.items()
    ]
