"""Soft bodies: closed forms, hard cases, gradients and speed, each number beside what one may expect."""

import functools
from collections.abc import Callable

from dln_jax.precision import in_float64
from dln_jax.studies.case import Case, Findings
from dln_jax.studies.soft_bodies import gradients, motions, robustness, sliding, speed, statics
from dln_jax.studies.soft_bodies.figures import FIGURES

__all__ = ["SUBJECTS", "cases"]

SUBJECTS: dict[str, dict[str, Callable[[bool], Findings]]] = {
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
"""quick -> findings, by subject and by name; only `speed` depends on the machine."""


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64 unless they say otherwise; quick ones are smaller."""
    return [
        Case(f"{subject}/{name}", in_float64(functools.partial(measure, quick)), draw=FIGURES.get(name))
        for subject, measures in SUBJECTS.items()
        for name, measure in measures.items()
    ]
