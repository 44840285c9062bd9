"""Benefit of designed motions: errors of identified parameters, compared with random motions of equal length.

Both motions have the same period, samples and noise, and the same least-squares fit. Errors of base parameters are
relative to their average standard deviation after random motions, so that units do not matter.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.excitation.candidates import Design, functions_at, states
from dln_jax.identification.excitation.task import Task


class Comparison(NamedTuple):
    """Ratios of errors after designed and random motions by seed [S]; errors are root mean squares over parameters."""

    ratios: Float[np.ndarray, " S"]
    """Values below one favour designed motions."""
    median: float
    worst: float


def compare(
    task: Task, designed: Sequence[Design], drawn: Sequence[Design], *, samples: int = 500, seeds: int = 50
) -> Comparison:
    """Compares least-squares errors after designed and random motions, pair by pair, with new noise for every seed.

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
    found = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=samples * task.noise.size)
        sizes = [np.sqrt(np.mean((inverses[seed % len(inverses)] @ noise / scale) ** 2)) for inverses in errors]
        found.append(sizes[0] / sizes[1])
    ratios = np.array(found)
    return Comparison(ratios, float(np.median(ratios)), float(np.max(ratios)))


def _solver(task: Task, designs: Sequence[Design], samples: int) -> list[np.ndarray]:
    """Matrices [B, N d], one per motion, that map normalised noise to errors of parameters."""
    functions = functions_at(task, task.period * np.arange(samples) / samples)
    inverses = []
    for design in designs:
        at = [np.asarray(each) for each in states(functions, design.motion.offset, design.motion.coefficients)]
        chunks = np.array_split(np.arange(samples), -(-samples // task.steps))
        rows = []
        for chunk in chunks:
            # The last chunk is padded, so that all chunks share one compiled program.
            filled = np.resize(chunk, task.steps)
            Phi = np.asarray(task.samples(*(each[filled] for each in at))[0])[: len(chunk)]
            rows.append(Phi[..., task.columns] / task.noise[:, None])
        W = np.concatenate(rows).reshape(samples * task.noise.size, -1)
        lengths = np.linalg.norm(W, axis=0)
        inverses.append(np.linalg.pinv(W / lengths) / lengths[:, None])
    return inverses
