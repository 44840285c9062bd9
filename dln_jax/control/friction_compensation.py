"""Separates friction from a model's other forces, and compensates it at the joints that have motors.

Dry friction jumps when a joint reverses, where a measured rate is mostly noise. With r = √(u² + s²) > |u|, the
compensation of a joint at rate u is

    gain (w F(r) + (1 - w) F(-r)),   w = (1 + u / r) / 2

This equals F(u) at rates well above the smoothing rate s. Below, it is a straight line through rest with the magnitude
of friction at s: no jump, and no work at rest. A gain below 1 never compensates all friction, so that it cannot drive a
joint.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError, Vector, require_positive

GAIN = 0.9
"""Share of the friction that is compensated."""


def without_friction(plant: Dynamics) -> Dynamics:
    """Removes the friction, whose slope at rest a linearisation should not contain; the energies stay.

    It requires friction that adds to the other forces, which holds for all systems without load in their transmissions.
    """
    return plant._replace(
        inverse_dynamics=lambda q, qd, qdd: plant.inverse_dynamics(q, qd, qdd) - plant.friction(q, qd),
        forward_dynamics=lambda q, qd, tau: plant.forward_dynamics(q, qd, tau + plant.friction(q, qd)),
        friction=lambda q, qd: jnp.zeros_like(qd),
    )


def friction_compensation(
    plant: Dynamics, active: Sequence[int], *, smoothing: Any, gain: float = GAIN
) -> Callable[[Vector, Vector], Array]:
    """(q, qd) -> forces of the active joints that compensate a share of their friction; qd measured or wanted.

    Args:
        plant: with friction, known or learned.
        active: joints with a motor.
        smoothing: s, rad/s or m/s, one per active joint or one for all: some times the noise of a measured rate.
        gain: share of the friction, above 0 and at most 1.

    Raises:
        InputError: a smoothing that is not positive, or a gain out of range.
    """
    for rate in np.ravel(smoothing):
        require_positive(smoothing=float(rate))
    if not 0 < gain <= 1:
        raise InputError(f"gain is {gain}; expected a share of the friction, above 0 and at most 1")
    driven = np.array(active)

    def forces(q: Vector, qd: Vector) -> Array:
        rate = qd[driven]
        size = jnp.sqrt(rate**2 + jnp.asarray(smoothing) ** 2)
        forwards = (1 + rate / size) / 2
        both = (plant.friction(q, qd.at[driven].set(side * size))[driven] for side in (1, -1))
        positive, negative = both
        return gain * (forwards * positive + (1 - forwards) * negative)

    return forces
