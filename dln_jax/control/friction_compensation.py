"""Friction apart from a model's other forces, and its compensation at the joints that have motors.

Dry friction jumps where a joint turns round, where a measured rate is noise alone. With r = √(u² + s²) > |u|, the
compensation of a joint at rate u is

    gain (w F(r) + (1 - w) F(-r)),   w = (1 + u / r) / 2

F(u) at rates well above the smoothing rate s, and a straight line through rest below, with as much as friction has at
s: no jump, and no work at rest. With a gain below 1 friction is never made up for entirely, so that no joint is driven
by it.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError, Vector, require_positive

GAIN = 0.9
"""Share of the friction that is made up for."""


def without_friction(plant: Dynamics) -> Dynamics:
    """The same energies without the friction, whose slope at rest no linearisation should have.

    Of a system whose friction adds to its other forces, as all have but those with load in their transmissions.
    """
    return plant._replace(
        inverse_dynamics=lambda q, qd, qdd: plant.inverse_dynamics(q, qd, qdd) - plant.friction(q, qd),
        forward_dynamics=lambda q, qd, tau: plant.forward_dynamics(q, qd, tau + plant.friction(q, qd)),
        friction=lambda q, qd: jnp.zeros_like(qd),
    )


def friction_compensation(
    plant: Dynamics, active: Sequence[int], *, smoothing: Any, gain: float = GAIN
) -> Callable[[Vector, Vector], Array]:
    """(q, qd) -> forces of the active joints that make up for a share of their friction; qd measured or wanted.

    Args:
        plant: with friction, known or learned.
        active: joints with a motor.
        smoothing: s, rad/s or m/s, one for each active joint or one for all: some times the noise of a measured rate.
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
