"""A swing-up on the board that recovers: first the plan, then a regulator, and the energy law where that is too far.

The controller trusts only angles; rates are their differences. It measures the delay when the plant first moves, and
predicts the current state by the known model (`control.with_prediction`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    Controller,
    Plan,
    field_of,
    holding_controls,
    linearise,
    regulated,
    sampled_lqr,
    saturated,
    value,
    with_differences,
    with_prediction,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import MIDPOINT, runge_kutta
from scripts.reports.control.board import GOAL, LIMIT, RATE, Motor, plant
from scripts.reports.control.disturbed_board import LONGEST
from scripts.reports.control.energy_laws import Law, pumping
from scripts.reports.control.planned import EVERY, Weights, follower

CUTOFF = 1000.0
"""Cut-off of the differences, Hz: above the sampling rate, so that they are hardly filtered."""
STATE_COST = np.diag([10.0, 10.0, 1.0, 1.0])
"""State cost of the regulator."""


class Recovery(NamedTuple):
    """Numbers of the controllers after the plan."""

    law: Law
    """The energy law, and the level at which the regulator takes over."""
    sweep: Any = 0.0
    """Amplitude of the sweep of the target energy, J: a wrong model has a wrong energy of the goal."""
    period: Any = 2.0
    """Period of the sweep, s."""


def by_angles(motor: Motor, controller: Controller) -> Controller:
    """A controller of x that uses only the measured angles and predicts the current state if they are delayed."""
    scene, B = plant(motor)
    field = field_of(dynamics(scene.closed_form), B)
    step = lambda x, u: runge_kutta(MIDPOINT, lambda t, x: field(x, u))(0.0, x, 1 / RATE)  # noqa: E731
    predicting = with_prediction(controller, step, states=4, controls=1, max_delay=LONGEST)
    seeing = with_differences(predicting, 2, rate=RATE, cutoff=CUTOFF, order=2)
    return Controller(seeing.start, lambda memory, t, y: seeing.act(memory, t, y[:2]))


def recovering(motor: Motor, weights: Weights, plan: Plan, control_cost: float) -> Callable[[Recovery], Controller]:
    """The plan; after its end the regulator where its value function is below the law's level, else the energy law.

    Args:
        motor: driven joint of the board's plant.
        weights: weights of the plan's cost.
        plan: plan from hanging.
        control_cost: control cost of the regulator.
    """
    scene, B = plant(motor)
    system, joints = dynamics(scene.closed_form), scene.needs.joints
    at = linearise(field_of(system, B), GOAL, holding_controls(system, GOAL[:2], B))
    regulator = sampled_lqr(at.A, at.B, STATE_COST, control_cost * np.eye(1), 1 / RATE)
    near, cost, far = regulated(regulator, GOAL, at.u, joints), value(regulator, GOAL, joints), pumping(motor)
    planned, last = follower(motor, weights, plan), EVERY * len(plan.u)

    def controller(recovery: Recovery) -> Controller:
        law = recovery.law

        def act(memory: tuple[Any, Array, Array], t: Array, y: Array) -> tuple[tuple[Any, Array, Array], Array]:
            inner, number, tau = memory
            inner, by_plan = planned.act(inner, t, y)
            beyond = recovery.sweep * jnp.sin(2 * jnp.pi * (number - last) / (RATE * recovery.period))
            by_energy = tau + law.share * (saturated(far(y, law.gains, beyond), -law.most, law.most) - tau)
            u = jnp.where(number < last, by_plan, jnp.where(cost(y) <= law.level, near(y), by_energy))
            u = saturated(u, -LIMIT, LIMIT)
            return (inner, number + 1, u), u

        return Controller((planned.start, jnp.asarray(0), jnp.zeros(1)), act)

    return controller
