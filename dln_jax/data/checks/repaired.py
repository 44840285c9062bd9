"""Logs whose faults are repaired one by one, and the prior of their torques without a robot."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks.energies import covariances, friction_columns
from dln_jax.data.checks.evidence import Prior
from dln_jax.data.schema import Trajectories

States = tuple[np.ndarray, np.ndarray, np.ndarray]
Build = Callable[[States, np.ndarray, np.ndarray | None], Prior]
"""(q, qd, qdd [n, d]), torques [n, d], gravity [3] or `None` for what is usual -> the prior of those torques."""


class Log(NamedTuple):
    """A log, and the faults that are repaired in it."""

    data: Trajectories
    rows: np.ndarray
    """Samples that are looked at [n]."""
    signs: Float[np.ndarray, " d"]
    """-1 for torques that have the wrong sign."""
    order: tuple[int, ...]
    """Columns of tau that belong to the joints."""
    delay: float = 0.0
    """Samples by which torques are late."""
    speed: float = 1.0
    """Times the speed that t states, with which the joints moved."""
    gravity: np.ndarray | None = None
    """m/s² [3], where it is another than stated."""

    def states(self) -> States:
        """At the times of the rows, or a part of a sample earlier if torques are late."""
        whole = int(np.floor(-self.delay))
        part, first = -self.delay - whole, self.rows + whole

        def at(values: np.ndarray) -> np.ndarray:
            return (1 - part) * values[first] + part * values[first + 1]

        return at(self.data.q), self.speed * at(self.data.qd), self.speed**2 * at(self.data.qdd)

    def torques(self, shift: int = 0) -> np.ndarray:
        """Of the joints, with their signs, so many samples later."""
        return self.data.tau[self.rows + shift][:, list(self.order)] * self.signs


def any_energy(joints: tuple[str, ...]) -> Build:
    """The prior without a robot: torques of any kinetic and potential energy, and friction."""

    def build(states: States, tau: np.ndarray, gravity: np.ndarray | None) -> Prior:
        del gravity  # any
        sizes = sizes_of(states[2], tau)
        parts = [part for each in covariances(states, states, joints, sizes) for part in each]
        return Prior(np.zeros(tau.size), parts, friction(states[1]))

    return build


def friction(qd: Float[np.ndarray, "n d"]) -> list[np.ndarray]:
    """Columns [n d, 4] of each joint's friction."""
    own = friction_columns(qd, np.maximum(qd.std(axis=0), 1e-12))
    n, d, count = own.shape
    found = []
    for joint in range(d):
        columns = np.zeros((n, d, count))
        columns[:, joint] = own[:, joint]
        found.append(columns.reshape(n * d, count))
    return found


def sizes_of(qdd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Sizes of the joints' inertias [d], by the ratio of torques to accelerations."""
    found = tau.std(axis=0) / np.maximum(qdd.std(axis=0), 1e-12)
    return np.maximum(found, 1e-3 * max(float(found.max()), 1e-300))
