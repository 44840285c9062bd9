"""Logs in which faults are repaired one by one, and the prior of their torques without a robot."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.checks.energies import covariances, friction_columns
from dln_jax.data.checks.evidence import Prior
from dln_jax.data.schema import Trajectories

States = tuple[np.ndarray, np.ndarray, np.ndarray]
Build = Callable[[States, np.ndarray, np.ndarray | None], Prior]
"""(q, qd, qdd [n, d]), torques [n, d], gravity [3] (`None` for the stated one) -> prior of those torques."""


class Log(NamedTuple):
    """A log and the faults repaired in it."""

    data: Trajectories
    rows: np.ndarray
    """Indices of the samples used [n]."""
    signs: Float[np.ndarray, " d"]
    """-1 for torques with the wrong sign."""
    order: tuple[int, ...]
    """Column of tau for every joint."""
    delay: float = 0.0
    """Delay of the torques in samples."""
    speed: float = 1.0
    """True speed of the joints relative to that by t."""
    gravity: np.ndarray | None = None
    """m/s² [3]; `None` for the stated gravity."""

    def states(self) -> States:
        """q, qd and qdd at the rows' times, shifted back by the delay with linear interpolation."""
        whole = int(np.floor(-self.delay))
        part, first = -self.delay - whole, self.rows + whole

        def at(values: np.ndarray) -> np.ndarray:
            return (1 - part) * values[first] + part * values[first + 1]

        return at(self.data.q), self.speed * at(self.data.qd), self.speed**2 * at(self.data.qdd)

    def torques(self, shift: int = 0) -> np.ndarray:
        """Torques of the joints with repaired signs and order, `shift` samples later."""
        return self.data.tau[self.rows + shift][:, list(self.order)] * self.signs


def any_energy(joints: tuple[str, ...]) -> Build:
    """Prior without a robot: torques of an arbitrary kinetic and potential energy, and friction."""

    def build(states: States, tau: np.ndarray, gravity: np.ndarray | None) -> Prior:
        del gravity  # any
        sizes = sizes_of(states[2], tau)
        parts = [part for each in covariances(states, states, joints, sizes) for part in each]
        return Prior(np.zeros(tau.size), parts, friction(states[1]))

    return build


def friction(qd: Float[np.ndarray, "n d"]) -> list[np.ndarray]:
    """Friction columns [n d, 4] of every joint."""
    own = friction_columns(qd, np.maximum(qd.std(axis=0), 1e-12))
    n, d, count = own.shape
    found = []
    for joint in range(d):
        columns = np.zeros((n, d, count))
        columns[:, joint] = own[:, joint]
        found.append(columns.reshape(n * d, count))
    return found


def sizes_of(qdd: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Magnitudes of the joints' inertias [d] as the ratio of torques to accelerations."""
    found = tau.std(axis=0) / np.maximum(qdd.std(axis=0), 1e-12)
    return np.maximum(found, 1e-3 * max(float(found.max()), 1e-300))
