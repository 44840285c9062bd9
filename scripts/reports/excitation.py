"""What designed motions are worth: errors of identified parameters after them and after random ones of equal length.

One motion each, of the same period and samples, the same noise drawn for both, and the same least squares. An error is
that of a base parameter in units of the deviation that it has on average after random motions, so that no parameter's
unit counts more than another's.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.identification.excitation.candidates import Design, functions_at, states
from dln_jax.identification.excitation.task import Task


class Comparison(NamedTuple):
    """Errors [S seeds] of designed over random motions, each a root of mean squares over parameters."""

    ratios: Float[np.ndarray, " S"]
    """Below one: designed motions are better."""
    median: float
    worst: float


def compare(
    task: Task, designed: Sequence[Design], drawn: Sequence[Design], *, samples: int = 500, seeds: int = 50
) -> Comparison:
    """Least squares after each pair of a designed and a random motion in turn, with new noise for each seed.

    Args:
        task: whose `noise` are the deviations.
        designed: by a criterion.
        drawn: random ones within the same limits.
        samples: of each motion, equally spaced over its period.
        seeds: of the noise.
    """
    errors = [_solver(task, designs, samples) for designs in (designed, drawn)]
    # Deviations of each parameter after random motions, on average over them.
    scale = np.sqrt(np.mean([np.sum(inverse**2, axis=1) for inverse in errors[1]], axis=0))
    found = []
    for seed in range(seeds):
        noise = np.random.default_rng(seed).normal(size=samples * task.noise.size)
        sizes = [np.sqrt(np.mean((inverses[seed % len(inverses)] @ noise / scale) ** 2)) for inverses in errors]
        found.append(sizes[0] / sizes[1])
    ratios = np.array(found)
    return Comparison(ratios, float(np.median(ratios)), float(np.max(ratios)))


def _solver(task: Task, designs: Sequence[Design], samples: int) -> list[np.ndarray]:
    """For each motion the matrix [B, N d] that turns noise, over its deviation, into errors of parameters."""
    functions = functions_at(task, task.period * np.arange(samples) / samples)
    inverses = []
    for design in designs:
        at = [np.asarray(each) for each in states(functions, design.motion.offset, design.motion.coefficients)]
        chunks = np.array_split(np.arange(samples), -(-samples // task.steps))
        rows = []
        for chunk in chunks:
            # All chunks are one program: the last is filled up.
            filled = np.resize(chunk, task.steps)
            Phi = np.asarray(task.samples(*(each[filled] for each in at))[0])[: len(chunk)]
            rows.append(Phi[..., task.columns] / task.noise[:, None])
        W = np.concatenate(rows).reshape(samples * task.noise.size, -1)
        lengths = np.linalg.norm(W, axis=0)
        inverses.append(np.linalg.pinv(W / lengths) / lengths[:, None])
    return inverses
