"""The cases of the control report."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from dln_jax.control import EnergyGains
from dln_jax.precision import in_float64
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from scripts.reports.case import Case, Findings
from scripts.reports.control import energy_laws, laws_in_c, learned, mpc_report, robustness, traces, tracking
from scripts.reports.control.board import Motor, criteria, plant, play
from scripts.reports.control.energy_laws import SwingUp, rows_of_criteria, rows_of_outcomes, success
from scripts.reports.control.planned import Weights, follower, search
from scripts.reports.control.values import equation, fits
from scripts.reports.rows import Row

TURN = 2 * np.pi / 2048
"""Resolution of an encoder, rad."""
SWING_UPS = {
    "cart-pole": SwingUp(
        cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825, friction=0.002),
        EnergyGains(2000.0, 10.0, 4.0),
        np.diag([10.0, 1.0, 0.1, 0.1]),
        0.1,
        10.0,
        1.0,
        (2.3e-5, TURN),
        0.02,
    ),
    "rotary-pendulum": SwingUp(
        rotary_pendulum(friction=1e-5),
        EnergyGains(2e7, 20.0, 5.0),
        np.diag([1.0, 1.0, 0.01, 0.01]),
        50.0,
        0.05,
        0.1,
        (TURN, TURN),
        0.1,
    ),
}
"""Swing-ups of plants of desktop size with known models."""
STARTS, SUCCESS = 1000, 0.995
PLANNED = {"acrobot": 0.66, "pendubot": None}
"""Score to reach; the best acrobot on the board has 0.655."""
HORIZONS = (1.5, 1.6, 1.8, 2.0)
WEIGHTS = (Weights(), Weights(torque=0.3, velocity=0.01, slope=3e-3))


def swing_up(name: str, quick: bool) -> Findings:
    """Share of starts that are up after ten seconds, and the time it takes."""
    found = success(SWING_UPS[name], 50 if quick else STARTS)
    words = f"of {len(found.seconds)} starts near hanging, on simulated hardware"
    rows = rows_of_outcomes(f"swing-up/{name}/known", found, words, SUCCESS)
    return Findings(rows, traces.traces(SWING_UPS[name]))


def by_plan(motor: Motor, quick: bool) -> Findings:
    """The best score of plans over some horizons, weights and guesses."""
    horizons, weights = ((1.6,), WEIGHTS[:1]) if quick else (HORIZONS, WEIGHTS)
    found, plan, weighted = search(motor, horizons, weights, guesses=1 if quick else 3)
    name = plant(motor)[0].name
    case, bound, words = f"board/{name}/planned", PLANNED[name], "version 2 of the board's"
    row = Row(case, "score", found, expected=words, bound=bound, at_least=True)
    run = play(motor, follower(motor, weighted, plan))
    return Findings([row, *rows_of_criteria(case, criteria(motor, run))])


def by_energy(motor: Motor, quick: bool) -> Findings:
    """The best score of laws drawn at random."""
    return energy_laws.board(motor, 100 if quick else energy_laws.DRAWS)


def cases(*, quick: bool = False) -> list[Case]:
    """All cases, named SUBJECT/NAME, in float64."""
    measures: dict[str, Callable[[bool], Findings]] = {
        **{f"swing-up/{name}": functools.partial(swing_up, name) for name in SWING_UPS},
        **{f"starts/{name}-starts": functools.partial(traces.from_anywhere, SWING_UPS[name]) for name in SWING_UPS},
        "board/acrobot-energy": functools.partial(by_energy, "elbow"),
        "board/pendubot-energy": functools.partial(by_energy, "shoulder"),
        "board/acrobot-planned": functools.partial(by_plan, "elbow"),
        "board/pendubot-planned": functools.partial(by_plan, "shoulder"),
        **equation.CASES,
        **fits.CASES,
        "tracking/seven-axis": tracking.tracking,
        "robustness/acrobot": functools.partial(robustness.robust, "elbow"),
        "robustness/pendubot": functools.partial(robustness.robust, "shoulder"),
        "laws/in-c": laws_in_c.laws,
        "mpc/cart-pole": mpc_report.mpc,
    }
    found = {name: functools.partial(measure, quick) for name, measure in measures.items()} | learned.cases(quick)
    drawn = {**traces.DRAWN, "robustness": robustness.draw}

    def drawing(name: str) -> Callable[..., Any] | None:
        return fits.DRAWINGS.get(name, drawn.get(name.split("/")[0]))

    return [Case(name, in_float64(measure), draw=drawing(name)) for name, measure in found.items()]
