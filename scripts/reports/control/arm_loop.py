"""The closed loop of the seven-axis arm at 1 kHz, in MuJoCo, with a model of the hardware.

Torques are limited and one sample late. Only angles are measured, by 14-bit encoders on the motor side of a 100:1 gear;
rates are low-passed differences of angles.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import Reference, Tracker, where_finite
from dln_jax.control.state_space import saturated
from dln_jax.data.robots import Robot
from dln_jax.mechanics.friction import joint_dissipation
from scripts.reports.robots.arm import STEP, D, Motion, simulator
from scripts.reports.robots.known_kinematics import USUAL_SCALE

LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Torque limits, N m."""
ENCODER_STEP = 2 * np.pi / (2**14 * 100)
"""Resolution of the encoders at the joint, rad."""
CUTOFF = 100.0
"""Cut-off of the low-pass on rates, Hz."""

Plant = Callable[[Motion], tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]
"""A motion -> the initial angles, and a function from torques to the next angles."""


class Tracked(NamedTuple):
    """Tracking result of one control law on one motion."""

    rms: float
    """Root mean square tracking error, mrad; NaN for a run that diverged to NaN."""
    trusted: float = np.nan
    """Share of samples that used the model, for a law with a fallback."""


def in_mujoco(robot: Robot) -> Plant:
    """The arm in MuJoCo, with dry friction as a constraint; `InputError` if MuJoCo is missing."""
    mujoco, model, data = simulator(robot)

    def start(wanted: Motion) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = wanted.q[0], wanted.qd[0]

        def step(tau: np.ndarray) -> np.ndarray:
            data.ctrl[:] = tau
            mujoco.mj_step(model, data)
            return np.array(data.qpos)

        return np.array(data.qpos), step

    return start


def friction_of(robot: Robot) -> Any:
    """Friction of the joints, with a smooth law of dry friction."""
    return joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE)


def track(plant: Plant, law: Tracker | Callable[..., Any], wanted: Motion, samples: int | None = None) -> Tracked:
    """Runs a closed loop along a motion with the hardware model of this module."""

    @jax.jit
    def asked(q: Any, qd: Any, now: Reference) -> Any:
        answer = law(q, qd, now)
        tau, usable = answer if isinstance(answer, tuple) else (answer, jnp.asarray(True))
        return saturated(where_finite(tau, q, qd), -LIMITS, LIMITS), usable

    q, step = plant(wanted)
    count = len(wanted.q) if samples is None else samples
    share = -np.expm1(-2 * np.pi * CUTOFF * STEP)
    qd, before, late, off, used = np.zeros(D), None, np.asarray(np.zeros(D)), [], 0
    for number in range(count):
        seen = ENCODER_STEP * np.round(q / ENCODER_STEP)
        qd = qd if before is None else qd + share * ((seen - before) / STEP - qd)
        before = seen
        tau, usable = asked(seen, qd, Reference(*(values[number] for values in wanted)))
        off.append(q - wanted.q[number])
        used += bool(usable)
        # Torques act one sample late; the first torque holds the arm at the start.
        now, late = (np.asarray(tau) if number == 0 else late), np.asarray(tau)
        q = step(now)
        if not np.isfinite(q).all():
            return Tracked(np.nan, used / (number + 1))
    return Tracked(1e3 * float(np.sqrt(np.mean(np.square(off)))), used / count)
