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
from scripts.reports.robots.simulated_arms import panda
from scripts.reports.run import Numbers


def excitation(*, joints: int = 7, designs: int = 6, draws: int = 60) -> Numbers:
    """Ratios of parameter errors after designed and random motions of the same series of a Panda, by criterion."""
    robot = panda(joints)
    model = make_rigid_tree(robot.tree, friction=True, velocity_scale=0.05)
    free = np.tile([-np.inf, np.inf], (joints, 1))
    limits = MotionLimits(robot.limits, robot.rates, robot.accelerations, free)
    task = make_task(model, model.init(jax.random.key(0)), limits, period=20.0, harmonics=5)
    drawn, starts = random_designs(task, designs), random_designs(task, designs, seed=1)
    numbers = {"excitation/random": {"condition_median": np.median([design.condition for design in drawn])}}
    for name, criterion in CRITERIA.items():
        optimise = make_optimiser(task, criterion)
        designed = [best_design(task, optimise, criterion, [start]) for start in starts]
        ratios = error_ratios(task, designed, drawn, seeds=draws)
        numbers[f"excitation/{name}"] = {
            "condition_median": np.median([design.condition for design in designed]),
            "error_worst": np.max(ratios),
            "error_median": np.median(ratios),
        }
    return numbers


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
    errors = [solvers(task, designs, samples) for designs in (designed, drawn)]
    # Standard deviations of the parameters after random motions, averaged over the motions.
    scale = np.sqrt(np.mean([np.sum(inverse**2, axis=1) for inverse in errors[1]], axis=0))
    ratios = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=samples * task.noise.size)
        sizes = [np.sqrt(np.mean((inverses[seed % len(inverses)] @ noise / scale) ** 2)) for inverses in errors]
        ratios.append(sizes[0] / sizes[1])
    return np.array(ratios)


def solvers(task: Task, designs: Sequence[Design], samples: int) -> list[np.ndarray]:
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
