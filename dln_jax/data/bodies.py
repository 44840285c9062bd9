"""Detects the coordinate order of interacting bodies from the balance of their forces.

Internal forces sum to zero along every axis for any law (translation invariance, Newton's third law). Sums over the
wrong columns mix axes and do not vanish, which reveals an order that the file does not state:

    imbalance = rms over samples and axes of |sum_i F_i| / (sqrt(bodies) rms F)      0 if balanced, about 1 by chance
"""

from typing import Literal, NamedTuple

import numpy as np

from dln_jax.types import JointSamples

Order = Literal["bodies", "axes"]
""""bodies" is x1, y1, x2, y2; "axes" is x1, x2, y1, y2."""
ORDERS: tuple[Order, ...] = ("bodies", "axes")
MOST_IMBALANCE = 0.2
"""Forces with at most this imbalance count as balanced; estimated rates are noisy."""
LEAST_CONTRAST = 3.0
"""Other orders are ruled out if their imbalance exceeds the best one's by this factor."""


class Bodies(NamedTuple):
    """Arrangement of the columns of q."""

    dimension: int
    """Axes per body: 2 or 3."""
    order: Order


def imbalance(forces: JointSamples, bodies: Bodies) -> float:
    """Returns the imbalance of the forces: 0 if they sum to zero along every axis, about 1 by chance."""
    size = np.sqrt(np.mean(forces**2))
    if not size > 0:
        return 0.0
    count = forces.shape[1] // bodies.dimension
    if bodies.order == "bodies":
        sums = forces.reshape(-1, count, bodies.dimension).sum(axis=1)
    else:
        sums = forces.reshape(-1, bodies.dimension, count).sum(axis=2)
    return float(np.sqrt(np.mean(sums**2)) / (size * np.sqrt(count)))


def arrangements(d: int) -> list[Bodies]:
    """Lists all arrangements of d coordinates as two or more bodies in a plane or in space."""
    return [Bodies(axes, order) for axes in (2, 3) if d % axes == 0 and d >= 2 * axes for order in ORDERS]


def find_bodies(forces: JointSamples, *, order: Order | None = None) -> Bodies | None:
    """Returns the only arrangement with balanced forces on the bodies; `None` unless there is exactly one.

    With a known `order`, returns the dimension with the best balance.
    """
    ways = [bodies for bodies in arrangements(forces.shape[1]) if order in (None, bodies.order)]
    ranked = sorted((imbalance(forces, bodies), bodies) for bodies in ways)
    if not ranked or order is not None:
        return ranked[0][1] if ranked else None
    (least, best), (next_least, _) = ranked[:2]
    clear = next_least > max(LEAST_CONTRAST * least, MOST_IMBALANCE)
    return best if clear and least <= MOST_IMBALANCE and np.any(forces) else None
