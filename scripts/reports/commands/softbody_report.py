"""Measure soft bodies: elements, hard cases, gradients, contact and speed, each number beside what one may expect.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), and writes report.json. All of it
is float64. Only `speed`, `compilation` and `rivals` depend on the machine. `rivals` measures the
other simulators that are installed (extra `[rivals]`), in minutes.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.precision import in_float64
from scripts.reports.case import Case, in_subjects, report_cases
from scripts.reports.soft_bodies import (
    compilation,
    contact,
    elements,
    gradients,
    robustness,
    speed,
    stiffness,
)
from scripts.reports.soft_bodies.rivals import cases as rivals
from scripts.reports.soft_bodies.rivals import finer, touching

MEASURES = {
    "references": (elements.locking, elements.slender),
    "hard": (
        *(robustness.time_steps, robustness.materials, robustness.bad_starts, robustness.mass_ratio, robustness.chain),
    ),
    "gradients": (gradients.crawler,),
    "contact": (
        *(contact.stack, contact.folding_beam, contact.impact, contact.sliding, contact.ring),
        *(contact.twisted_bar, contact.gripper, contact.bounce, contact.gradients),
    ),
    "speed": (
        *(speed.creature, speed.beams, speed.backward, speed.solver_choice),
        *(stiffness.steps, stiffness.factorisation),
    ),
    "compilation": (compilation.steps, compilation.gradient),
    "rivals": (rivals.swing, rivals.drop, rivals.hanging, finer.mesh, finer.gradient, touching.blocks),
}
"""Functions quick -> findings, by subject."""


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(MEASURES, several=True)] = ",".join(name for name in MEASURES if name != "rivals")
    """Subjects (default: all but rivals)."""
    quick: bool = False
    """Smaller meshes, fewer and shorter motions: 90 s instead of minutes."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", options.only, MEASURES)
    chosen = in_subjects(cases(quick=options.quick), subjects)
    report_cases(options, "softbody", chosen, dtype="float64", seeds=[0])


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64; quick ones are smaller."""
    return [
        Case(
            f"{subject}/{measure.__name__.replace('_', '-')}",
            in_float64(partial(measure, quick)),
        )
        for subject, measures in MEASURES.items()
        for measure in measures
    ]
