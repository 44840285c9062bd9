"""Benefit of designed motions: errors of identified parameters, compared with random motions of equal length.

Both motions have the same period, samples and noise, and the same least-squares fit. Errors of base parameters are
relative to their average standard deviation after random motions, so that units do not matter.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.identification.excitation.candidates import Design, functions_at, random_designs, states
from dln_jax.identification.excitation.design import CRITERIA, best_design, make_optimiser
from dln_jax.identification.excitation.limits import MotionLimits
from dln_jax.identification.excitation.task import Task, make_task
from dln_jax.models.rigid_tree import make_rigid_tree
from scripts.reports.case import Findings
from scripts.reports.robots.simulated_arms import panda
from scripts.reports.rows import Row

PERIOD, HARMONICS = 20.0, 5
SMOOTH = 0.05
"""Velocity scale of the dry friction in the design of motions, rad/s."""
DESIGNS, SEEDS = 6, 60
"""Number of motions of either kind, and number of seeds for the noise."""


def excitation(quick: bool) -> Findings:
    """Ratios of parameter errors after designed and random motions of the same series, by criterion."""
    task, count = lip_task(3 if quick else 7), 2 if quick else DESIGNS
    drawn, starts = random_designs(task, count), random_designs(task, count, seed=1)
    rows = [_condition("random", drawn)]
    for criterion in CRITERIA:
        optimise = make_optimiser(task, CRITERIA[criterion])
        designed = [best_design(task, optimise, CRITERIA[criterion], [start]) for start in starts]
        ratios = error_ratios(task, designed, drawn, seeds=SEEDS)
        case, words = f"excitation/{criterion}", f"of {SEEDS} draws of noise, over errors after random motions"
        bound = 1.0 if criterion == "information" else None
        rows += [
            _condition(criterion, designed),
            Row(case, "error_worst", float(np.max(ratios)), expected=words),
            Row(case, "error_median", float(np.median(ratios)), bound=bound, expected=words),
        ]
    return Findings(rows)


def _condition(name: str, designs: Sequence[Design]) -> Row:
    median = float(np.median([design.condition for design in designs]))
    return Row(f"excitation/{name}", "condition_median", median)


def lip_task(active: int) -> Task:
    """The design task for the Panda of the LIP protocol, with its limits and unknown inertias and friction."""
    robot = panda(active)
    model = make_rigid_tree(robot.tree, friction=True, velocity_scale=SMOOTH)
    free = np.tile([-np.inf, np.inf], (active, 1))
    limits = MotionLimits(robot.limits, robot.rates, robot.accelerations, free)
    return make_task(model, model.init(jax.random.key(0)), limits, period=PERIOD, harmonics=HARMONICS)


def error_ratios(
    task: Task, designed: Sequence[Design], drawn: Sequence[Design], *, samples: int = 500, seeds: int = 50
) -> Float[np.ndarray, " seeds"]:
    """Errors after designed motions over those after random ones by seed; root mean squares over parameters.

    Compares least-squares errors pair by pair, with new noise for every seed. Values below one favour designed motions.

    Args:
        task: task whose `noise` holds the standard deviations.
        designed: motions optimised for a criterion.
        drawn: random motions within the same limits.
        samples: number of equally spaced samples in a motion's period.
        seeds: number of seeds for the noise.
    """
    errors = [_solver(task, designs, samples) for designs in (designed, drawn)]
    # Standard deviations of the parameters after random motions, averaged over the motions.
    scale = np.sqrt(np.mean([np.sum(inverse**2, axis=1) for inverse in errors[1]], axis=0))
    ratios = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=samples * task.noise.size)
        sizes = [np.sqrt(np.mean((inverses[seed % len(inverses)] @ noise / scale) ** 2)) for inverses in errors]
        ratios.append(sizes[0] / sizes[1])
    return np.array(ratios)


def _solver(task: Task, designs: Sequence[Design], samples: int) -> list[np.ndarray]:
    """Matrices [B, N d], one per motion, that map normalised noise to errors of parameters."""
    functions = functions_at(task, task.period * np.arange(samples) / samples)
    inverses = []
    for design in designs:
        at = list(map(np.asarray, states(functions, design.motion.offset, design.motion.coefficients)))
        rows = []
        for chunk in np.array_split(np.arange(samples), -(-samples // task.steps)):
            # The last chunk is padded, so that all chunks share one compiled program.
            filled = np.resize(chunk, task.steps)
            Phi = np.asarray(task.samples(*(array[filled] for array in at))[0])[: len(chunk)]
            rows.append(Phi[..., task.columns] / task.noise[:, None])
        W = np.concatenate(rows).reshape(samples * task.noise.size, -1)
        lengths = np.linalg.norm(W, axis=0)
        inverses.append(np.linalg.pinv(W / lengths) / lengths[:, None])
    return inverses
