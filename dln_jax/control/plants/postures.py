"""The highest and the lowest posture of a plant with gravity."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from dln_jax.types import InputError

TURNS = 8
"""Number of initial angles of a joint for the search of the highest and the lowest posture."""
LEVEL = 1e-3
"""Smallest change of energy by a passive joint that counts as gravity, as a share of the range of the energies."""


def extremes(
    potential: Callable[[np.ndarray], float],
    joints: Sequence[str],
    driven: Sequence[int],
    ranges: Float[np.ndarray, "d 2"],
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the postures [d] of least and of greatest potential energy.

    Slides stay in the middle of their ranges, or at zero without one: the energy is linear in them. Angles that do not
    matter stay at zero. Without gravity both postures are the one nearest to zero.

    Args:
        potential: q [d] -> potential energy, J.
        joints: kinds.
        driven: numbers of the joints with a motor.
        ranges: limits of the coordinates, infinite for none.

    Raises:
        InputError: the limits exclude every posture of the search, a passive joint is a slide, or gravity does not move
            it.
    """
    from scipy.optimize import minimize

    turns = 2 * np.pi / TURNS * np.arange(1 - TURNS // 2, TURNS // 2 + 1)
    choices = [
        [turn for turn in turns if low <= turn <= high]
        if kind == "revolute"
        else [(low + high) / 2 if np.isfinite([low, high]).all() else 0.0]
        for kind, (low, high) in zip(joints, ranges, strict=True)
    ]
    hinges = np.array([kind == "revolute" for kind in joints])
    grid = sorted(map(np.array, itertools.product(*choices)), key=lambda q: float(np.abs(q).sum()))
    if not grid:
        raise InputError("the limits of the joints exclude every posture of the search; give goal and hanging")
    energies = np.array([potential(q) for q in grid])
    size = float(np.ptp(energies))
    for k in sorted(set(range(len(joints))) - set(driven)):
        if not hinges[k]:
            raise InputError(f"nothing holds the passive slide {k}; expected hinges without a motor only")
        moved = [
            abs(potential(q + np.pi / 2 * np.eye(len(joints))[k]) - e) for q, e in zip(grid, energies, strict=True)
        ]
        if not max(moved) > LEVEL * max(size, 1e-12):
            raise InputError(f"gravity does not move the passive joint {k}; expected a plant that hangs and stands")
    postures = []
    for sign in (1.0, -1.0):
        ties = np.flatnonzero(sign * energies <= (sign * energies).min() + 1e-9 * max(size, 1e-12))
        start, options = grid[ties[0]], {"gtol": 1e-7}
        energy = lambda q: sign * potential(np.where(hinges, q, start)) / (size or 1.0)  # noqa: B023, E731
        best = minimize(energy, start, method="BFGS", options=options)
        postures.append(np.clip(np.where(np.abs(best.x) < 1e-9, 0.0, best.x), ranges[:, 0], ranges[:, 1]))
    return postures[0], postures[1]
