"""By how much torques are late against positions: the shift at which a model linear in its parameters fits best."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.checks.findings import Finding

LATE = 0.3
"""Samples of delay that are worth a word, where the model is that of the robot."""
CONSTANT = 1e-9
"""A torque whose deviation is smaller than this share of its size is constant."""
GAIN = 1.02
"""By which the squared error falls with it."""


class Delays(NamedTuple):
    """Delays that were tried, and the best."""

    delay: float
    """Samples by which torques are late, to a fraction of one."""
    gain: float
    """Squared error at no delay over that at this one."""
    tried: Float[np.ndarray, " S"]
    """Samples."""
    error: Float[np.ndarray, " S"]
    """Share of the torques' variance that is left."""
    findings: list[Finding]


def vertex(values: np.ndarray, lowest: int) -> float:
    """Where the parabola through a lowest value and its neighbours has its own lowest, in steps from it."""
    if not 0 < lowest < len(values) - 1:
        return 0.0
    before, here, after = values[lowest - 1 : lowest + 2]
    curvature = before - 2 * here + after
    return float(0.5 * (before - after) / curvature) if curvature > 0 else 0.0


def away_from_ends(part: Int[np.ndarray, " N"], farthest: int) -> Int[np.ndarray, " n"]:
    """Samples with so many neighbours on both sides in their own part."""
    places = np.arange(farthest, len(part) - farthest)
    return places[(part[places - farthest] == part[places]) & (part[places + farthest] == part[places])]


def delay_of(columns: Float[np.ndarray, "nd P"], shifted: Float[np.ndarray, "n d S"], step: float) -> Delays:
    """The delay at which columns explain torques best.

    Args:
        columns: of a model linear in its parameters, sample by sample.
        shifted: torques so many samples later, from -(S - 1) / 2 to (S - 1) / 2.
        step: s, of a sample.
    """
    n, d, count = shifted.shape
    deviation, size = shifted.std(axis=(0, 2)), np.abs(shifted).max(axis=(0, 2))
    sizes = np.where(deviation > CONSTANT * size, deviation, np.inf)  # a constant torque says nothing of time
    weighted = (columns.reshape(n, d, -1) / sizes[:, None]).reshape(n * d, -1)
    norms = np.linalg.norm(weighted, axis=0)
    seen = norms > 1e-9 * norms.max(initial=0.0)
    if not seen.any():
        return Delays(0.0, 1.0, np.arange(count) - count // 2.0, np.ones(count), [])
    left, values, _ = np.linalg.svd(weighted[:, seen] / norms[seen], full_matrices=False)
    basis = left[:, values > 1e-8 * values[0]]
    tau = (shifted / sizes[:, None]).reshape(n * d, count)
    centred = shifted / sizes[:, None] - np.mean(shifted / sizes[:, None], axis=0)
    total = np.maximum(np.sum(centred**2, axis=(0, 1)), np.finfo(float).tiny)
    error = np.maximum(np.sum(tau**2, axis=0) - np.sum((basis.T @ tau) ** 2, axis=0), 1e-14 * total) / total
    best, middle = int(np.argmin(error)), count // 2
    delay = best - middle + vertex(error, best)
    gain = float(error[middle] / error[best])
    findings = []
    if abs(delay) > LATE and gain > GAIN:
        said = f"torques are {abs(delay) * step * 1e3:.3g} ms {'late' if delay > 0 else 'early'} against positions"
        remedy = "shift one of them in time, or repair the clock of the log"
        findings.append(Finding("warning", "delay", said, remedy))
    return Delays(delay, gain, np.arange(count) - float(middle), error, findings)
