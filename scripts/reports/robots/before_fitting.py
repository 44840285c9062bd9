"""Cases of the report on steps before a fit: exciting motions, and the preparation of encoder data."""

import jax
import numpy as np

from dln_jax.identification.excitation.candidates import Design, random_designs
from dln_jax.identification.excitation.design import CRITERIA, best_design, make_optimiser
from dln_jax.identification.excitation.limits import MotionLimits
from dln_jax.identification.excitation.task import Task, make_task
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.case import Findings
from scripts.reports.encoder_data import encoder_rows
from scripts.reports.excitation import compare
from scripts.reports.robots.arm import ENCODER_NOISE, TORQUE_NOISE, arm
from scripts.reports.robots.known_kinematics import FULL, QUICK, logs
from scripts.reports.rows import Row, expect

PARTS = 3
"""Number of logs with equal numbers of motions and independent noise."""
PERIOD, HARMONICS = 20.0, 5
SMOOTH = 0.05
"""Velocity scale of the dry friction in the design of motions, rad/s."""
DESIGNS, SEEDS = 6, 60
"""Number of motions of either kind, and number of seeds for the noise."""


def encoders(quick: bool) -> Findings:
    """Errors by preparation of q and tau, with viscous friction and with MuJoCo's dry friction."""
    rows, effort = [], QUICK if quick else FULL
    for name, robot in (("viscous", arm(coulomb=False)), ("coulomb", arm(coulomb=True))):
        random = np.random.default_rng(0)
        exact, test = (logs(robot, random, count) for count in (effort.motions, effort.unseen))
        parts = np.array_split(np.arange(effort.motions), 1 if quick else PARTS)
        found = encoder_rows(
            robot.tree,
            exact,
            test,
            noise_q=ENCODER_NOISE,
            noise_tau=TORQUE_NOISE,
            parts=[each.tolist() for each in parts],
        )
        rows += [row._replace(case=row.case.replace("encoders/", f"encoders/{name}/")) for row in found]
    return Findings(rows)


def excitation(quick: bool) -> Findings:
    """Ratios of parameter errors after designed and random motions of the same series, by criterion."""
    task = lip_task(3 if quick else 7)
    count = 2 if quick else DESIGNS
    drawn = random_designs(task, count)
    starts = random_designs(task, count, seed=1)
    rows = [Row("excitation/random", "condition_median", float(np.median([each.condition for each in drawn])))]
    for criterion in CRITERIA:
        designed = designs(task, criterion, starts)
        found = compare(task, designed, drawn, seeds=SEEDS)
        case, words = f"excitation/{criterion}", f"of {SEEDS} draws of noise, over errors after random motions"
        rows += [
            Row(case, "condition_median", float(np.median([each.condition for each in designed]))),
            Row(case, "error_worst", found.worst, expected=words),
        ]
        if criterion == "information":
            rows.append(expect(case, "error_median", words, found.median, 1.0))
        else:
            rows.append(Row(case, "error_median", found.median, expected=words))
    return Findings(rows)


def lip_task(active: int) -> Task:
    """The design task for the Panda of the LIP protocol, with its limits and unknown inertias and friction."""
    robot = panda(active)
    model = make_rigid_tree(robot.tree, friction=True, velocity_scale=SMOOTH)
    free = np.tile([-np.inf, np.inf], (active, 1))
    limits = MotionLimits(robot.limits, robot.rates, robot.accelerations, free)
    return make_task(model, model.init(jax.random.key(0)), limits, period=PERIOD, harmonics=HARMONICS)


def designs(task: Task, criterion: str, starts: list[Design]) -> list[Design]:
    """Optimises one motion per start."""
    optimise = make_optimiser(task, CRITERIA[criterion])
    return [best_design(task, optimise, CRITERIA[criterion], [start]) for start in starts]
