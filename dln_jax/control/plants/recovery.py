"""Swing-up and recovery of a plant by repeated plans, from numbers in the natural scales of its model.

Plans are those of `planned`, with a cost of the distance from the goal on the way, so that they do not put it off, and
with any number of turns of the passive joints. They start from three first guesses: no control, and swings of half the
motors' limits that begin to either side.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.closed_loop import Controller
from dln_jax.control.plants.planned import plan_problem, steps_of
from dln_jax.control.plants.plant import Layout
from dln_jax.control.plants.scales import Scales
from dln_jax.control.recovery import recovery_by_plans
from dln_jax.control.regulators import Regulator, regulated, value
from dln_jax.control.swing_up import SwingUpNumbers, Upright
from dln_jax.control.tracking import friction_compensation
from dln_jax.control.trajectories import first_plan

HORIZON, FINENESS = 6.0, 7.0
"""Duration of the plans in units of 1 / lambda, and their steps per 1 / lambda."""
SHARE = 0.9
"""Largest share of the motors' limits in a plan."""
EFFORT, SOON, AT_END = 0.1, 1.0, 100.0
"""Weights of the controls, of the distance from the goal on the way, and of the errors at the end."""
SWINGS = (0.0, 0.5, -0.5)
"""Sizes of the first guesses, as shares of the motors' limits."""


def recovering(
    upright: Upright, layout: Layout, scales: Scales, settings: SwingUpNumbers, regulator: Regulator, level: Any
) -> Controller:
    """Returns the controller of states x by repeated plans and a regulator.

    Args:
        upright: the model.
        layout: layout of the plant.
        scales: scales of the model.
        settings: compensation of the friction and its smoothing.
        regulator: regulator at the goal; it may be traced.
        level: the regulator acts while the cost to go is below it.
    """
    every, size = steps_of(layout, scales, FINENESS), np.abs(layout.limits.control).min(axis=1)
    dt = every / layout.rate
    problem = plan_problem(
        upright, layout, scales, EFFORT, every=every, share=SHARE, at_end=AT_END, soon=SOON
    )  # fmt: skip
    t = dt * np.arange(round(HORIZON / scales.fall / dt))
    swings = np.array(SWINGS)[:, None, None] * np.sin(scales.fall * t)[:, None] * size
    hanging = jnp.concatenate([jnp.asarray(layout.hanging), jnp.zeros(len(layout.joints))])
    plans = jax.vmap(lambda u: first_plan(problem, hanging, u))(swings)
    near = regulated(regulator, upright.at.x, upright.at.u, layout.joints)
    cost = value(regulator, upright.at.x, layout.joints)
    plain = recovery_by_plans(problem, plans, near, cost, level, rate=layout.rate, every=every)
    if settings.compensation == 0:
        return plain
    to_controls = jnp.linalg.pinv(upright.B[np.array(upright.parts.active)])
    friction = friction_compensation(
        upright.model, upright.parts.active, smoothing=settings.smoothing, gain=settings.compensation
    )  # fmt: skip

    def act(memory: Any, t: Array, x: Array) -> tuple[Any, Array]:
        memory, u = plain.act(memory, t, x)
        return memory, u + to_controls @ friction(*jnp.split(x, 2))

    return Controller(plain.start, act)
