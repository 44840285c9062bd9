"""The board's robustness table for planned, energy-based and combined controllers: rows and a figure."""

from typing import Any

import jax.numpy as jnp
from matplotlib.figure import Figure

from dln_jax.control import Controller
from scripts.reports.case import Findings
from scripts.reports.control.board import Motor, criteria, plant, play, score
from scripts.reports.control.disturbed_board import CRITERIA, robustness
from scripts.reports.control.energy_laws import Law, best_law, controllers_by_energy
from scripts.reports.control.planned import Weights, follower, search
from scripts.reports.control.recovering import Recovery, by_angles, recovering
from scripts.reports.figures.robustness import shares
from scripts.reports.rows import Row

PUBLISHED = {
    "acrobot": {
        "History SAC": (58.1, 23.8, 100.0, 100.0, 90.5, 78.0, 0.751),
        "AR-EAPO": (67.6, 28.6, 100.0, 100.0, 76.2, 64.0, 0.727),
        "evolSAC": (64.8, 23.8, 100.0, 100.0, 47.6, 76.0, 0.687),
        "TVLQR": (48.1, 19.0, 100.0, 95.2, 23.8, 78.0, 0.607),
        "iLQR MPC": (6.7, 9.5, 90.5, 52.4, 4.8, 42.0, 0.343),
        "MC-PILCO": (9.0, 9.5, 19.0, 52.4, 4.8, 50.0, 0.241),
        "iLQR Riccati": (4.8, 9.5, 9.5, 52.4, 4.8, 2.0, 0.138),
    },
    "pendubot": {
        "AR-EAPO": (87.6, 81.0, 100.0, 100.0, 81.0, 98.0, 0.913),
        "evolSAC": (75.2, 57.1, 100.0, 100.0, 71.4, 68.0, 0.786),
        "History SAC": (68.1, 47.6, 100.0, 100.0, 100.0, 46.0, 0.770),
        "TVLQR": (62.9, 90.5, 100.0, 100.0, 42.9, 64.0, 0.767),
        "iLQR MPC": (31.9, 90.5, 100.0, 100.0, 38.1, 44.0, 0.674),
        "MC-PILCO": (24.8, 76.2, 61.9, 95.2, 28.6, 82.0, 0.614),
        "iLQR Riccati": (5.2, 38.1, 9.5, 85.7, 14.3, 0.0, 0.255),
    },
}
"""Published percentages by criterion, and the mean (version 2; the board rounds the mean)."""
HORIZON, DRAWS = 1.6, 300
"""Horizon of the plan, s, and number of random energy laws, from which the best nominal score is chosen."""
# Gains, the regulator's level, the share of a new torque and the largest one; the sweep and its period. Chosen from
# hundreds of random draws by the number of random states that swing up undisturbed, then from eighty draws about the
# best by disturbances drawn like those of the table, but not the same ones.
RECOVERIES: dict[Motor, tuple[tuple[float, float, float], float, float, float, float, float]] = {
    "elbow": ((2.89, 17.1, 41.5), 313.0, 1.0, 6.0, 0.2, 1.5),
    "shoulder": ((47.8, 2.15, 3.44), 63.9, 1.0, 6.0, 0.2, 1.0),
}
CONTROL_COSTS: dict[Motor, float] = {"elbow": 1.0, "shoulder": 10.0}
"""Control costs of the regulators that take over after the plan."""


def recovery(motor: Motor) -> Recovery:
    """The chosen numbers of `RECOVERIES`."""
    *law, sweep, period = RECOVERIES[motor]
    return Recovery(Law(*map(jnp.array, law)), sweep, period)


def controllers(motor: Motor, quick: bool) -> dict[str, Controller]:
    """Our controllers by name, with gains and plans of the undisturbed plant."""
    weights = Weights()
    _, plan, weights = search(motor, (HORIZON,), (weights,), guesses=1)
    law = best_law(motor, 20 if quick else DRAWS)
    return {
        "ours-planned": follower(motor, weights, plan),
        "ours-by-energy": controllers_by_energy(motor)(law),
        "ours-planned-by-angles": by_angles(motor, follower(motor, weights, plan)),
        "ours-recovering": by_angles(motor, recovering(motor, weights, plan, CONTROL_COSTS[motor])(recovery(motor))),
    }


def robust(motor: Motor, quick: bool) -> Findings:
    """Shares of successes by criterion, their mean, and the score of the undisturbed plant."""
    name, table = plant(motor)[0].name, {}
    rows: list[Row] = []
    best = max(each[-1] for each in PUBLISHED[name].values())
    words = "mean share of successes, beside the board's best"
    for which, controller in controllers(motor, quick).items():
        case = f"robustness/{name}/{which.removeprefix('ours-')}"
        found = robustness(motor, controller, every=10 if quick else 1)
        table[which] = found
        rows += [Row(case, f"share_{key}", found[key]) for key in CRITERIA]
        rows.append(Row(case, "share_mean", found["mean"], reference=best, expected=words))
        rows.append(Row(case, "score_undisturbed", score(criteria(motor, play(motor, controller)))))
    for rival, values in PUBLISHED[name].items():
        shown = [*(each / 100 for each in values[:-1]), values[-1]]
        table[rival] = dict(zip((*CRITERIA, "mean"), shown, strict=True))
    return Findings(rows, {name: table})


def draw(curves: dict[str, Any]) -> Figure:
    """Draws the board's table with our controllers above it."""
    return shares(curves)
