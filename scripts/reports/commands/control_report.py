"""Measure controllers: swing-ups, a board, learned models, foreign plants, value functions, tracking, plans, and C.

Prints one table (case, quantity, expected, value, unit, reference, to reach, pass), and writes report.json.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated

from dln_jax.cli.arguments import choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.precision import in_float64
from scripts.reports.case import Case, Findings, in_subjects, report_cases
from scripts.reports.control import (
    arm_in_real_time,
    contacts,
    energy_laws,
    estimates,
    foreign_plants,
    late_answers,
    laws_in_c,
    learned,
    over_a_socket,
    planned,
    plans,
    rail,
    real_time,
    replanning,
    robustness,
    swing_ups,
    tracking,
)
from scripts.reports.control.board import Motor
from scripts.reports.control.values import equation, fits

MOTORS: dict[str, Motor] = {"acrobot": "elbow", "pendubot": "shoulder"}
MEASURES: dict[str, Callable[[bool], Findings]] = {
    **{f"swing-up/{name}": partial(swing_ups.swing_up, name) for name in swing_ups.SWING_UPS},
    **{f"starts/{name}-starts": partial(swing_ups.from_anywhere, name) for name in swing_ups.SWING_UPS},
    **{f"board/{name}-energy": partial(energy_laws.board, motor) for name, motor in MOTORS.items()},
    **{f"board/{name}-planned": partial(planned.by_plan, motor) for name, motor in MOTORS.items()},
    **learned.CASES,
    **foreign_plants.CASES,
    **over_a_socket.CASES,
    **late_answers.CASES,
    **equation.CASES,
    "value/pendulum": fits.pendulum,
    **{f"value/{name}": partial(fits.beside_shooting, name) for name in ("cart-pole", "rotary-pendulum")},
    **estimates.CASES,
    "contacts/two-link": contacts.contacts,
    "tracking/seven-axis": tracking.tracking,
    **{f"robustness/{name}": partial(robustness.robust, motor) for name, motor in MOTORS.items()},
    **{f"replanning/{name}": partial(replanning.replanned, motor) for name, motor in MOTORS.items()},
    "laws/in-c": laws_in_c.laws,
    "plans/beside-ipopt": plans.plans,
    "realtime/cart-pole": real_time.cart_pole_report,
    "realtime/seven-axis": arm_in_real_time.seven_axis_report,
    "rail/cart-pole": rail.on_a_rail,
}
"""Functions quick -> findings, by SUBJECT/NAME."""
SUBJECTS = tuple(dict.fromkeys(name.split("/")[0] for name in MEASURES))


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    quick: bool = False
    """Fewer starts, draws and plans."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", options.only, SUBJECTS)
    report_cases(options, "control", in_subjects(cases(quick=options.quick), subjects), dtype="float64")


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, in float64."""
    return [Case(name, in_float64(partial(measure, quick))) for name, measure in MEASURES.items()]
