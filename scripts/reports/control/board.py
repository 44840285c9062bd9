"""The acrobot and the pendubot of a public board (Wiebe et al. 2022, "RealAIGym"): its plant, integration and score.

Ten seconds of the classical Runge-Kutta method at 500 Hz, from hanging at rest. A run succeeds if the tip rises above
nine tenths of the stretched length and stays there to the end. Score v2 is

    success (1 - 1/5 sum over criteria of tanh(pi criterion / size))
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import (
    ClosedLoopRun,
    Controller,
    Hardware,
    Linearisation,
    field_of,
    holding_controls,
    linearise,
    simulate,
)
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import Links, two_link_pendulum
from dln_jax.scenes.scene import Scene
from scripts.reports.rows import Row

RATE, SECONDS = 500.0, 10.0
LIMIT = 6.0
"""Torque limit, N m."""
HEIGHT = 0.9
"""Height of the tip above the shoulder that counts as up, relative to the stretched length."""
GOAL = np.array([np.pi, 0.0, 0.0, 0.0])
Motor = Literal["elbow", "shoulder"]


class Criteria(NamedTuple):
    """Criteria of a run; smaller is better."""

    time: float
    """Time until the tip stays up, s; infinite if it does not."""
    energy: float
    """Sum of |dq tau|, J."""
    torque_cost: float
    """Integral of tau², N² m² s."""
    smoothness: float
    """Standard deviation of the differences of successive torques, N m."""
    velocity_cost: float
    """Integral of |qd|², rad²/s."""


SIZES = Criteria(20.0, 60.0, 20.0, 0.1, 400.0)
UNITS = ("s", "J", "N² m² s", "N m", "rad²/s")
"""Units of the criteria."""


def plant(motor: Motor) -> tuple[Scene, Array]:
    """The scene and its actuation matrix [2, 1]."""
    scene = two_link_pendulum(motor)
    return scene, jnp.asarray(scene.needs.actuation)


def closed_loop(motor: Motor, controller: Controller) -> ClosedLoopRun:
    """A run with the board's settings, not compiled."""
    scene, B = plant(motor)
    field, lab = field_of(dynamics(scene.energies), B), Hardware(-LIMIT, LIMIT)
    return simulate(field, controller, np.zeros(4), seconds=SECONDS, rate=RATE, controls=1, hardware=lab)


def play(motor: Motor, controller: Controller) -> ClosedLoopRun:
    """Runs the closed loop with the board's settings."""
    return jax.jit(lambda: closed_loop(motor, controller))()


def at_goal(motor: Motor, system: Dynamics) -> Linearisation:
    """The linearisation of the plant about its goal."""
    B = plant(motor)[1]
    return linearise(field_of(system, B), GOAL, holding_controls(system, GOAL[:2], B))


def criteria(motor: Motor, run: ClosedLoopRun) -> Criteria:
    """The criteria of a run."""
    driven = {"shoulder": 0, "elbow": 1}[motor]
    q, qd = np.split(np.asarray(run.x), 2, axis=1)
    u = np.asarray(run.u)[:, 0]
    inner, outer = Links().lengths
    up = -inner * np.cos(q[:, 0]) - outer * np.cos(q.sum(axis=1)) > HEIGHT * (inner + outer)
    stays = len(up) - np.argmin(up[::-1]) if not up.all() else 0
    return Criteria(
        time=stays / RATE if up[-1] else np.inf,
        energy=float(np.sum(np.abs(np.diff(q[:, driven]) * u))),
        torque_cost=float(np.sum(u**2) / RATE),
        smoothness=float(np.std(np.diff(u))),
        velocity_cost=float(np.sum(qd**2) / RATE),
    )


def score(numbers: Criteria) -> float:
    """Score of version 2, from 0 to 1; 0 without success or if a criterion is NaN."""
    if not np.isfinite(numbers).all():
        return 0.0
    return 1 - float(np.mean([np.tanh(np.pi * value / size) for value, size in zip(numbers, SIZES, strict=True)]))


def rows_of_criteria(case: str, numbers: Criteria) -> list[Row]:
    """The five criteria of the score."""
    return [
        Row(case, key, float(number), unit) for key, number, unit in zip(numbers._fields, numbers, UNITS, strict=True)
    ]
