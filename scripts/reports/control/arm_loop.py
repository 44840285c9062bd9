"""The closed loop of the seven-axis arm at 1 kHz, in MuJoCo or in our own equations, and its hardware.

Torques are limited and a sample late; angles alone are read, by encoders of 14 bits on the motors' side of a gear of
100, and rates are their differences through a low-pass.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import Reference, Tracker, limited, where_finite
from dln_jax.data.robots import Robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.mechanics.trees import tree_system
from scripts.reports.robots.arm import STEP, D, Motion, simulator
from scripts.reports.robots.known_kinematics import USUAL_SCALE

LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""N m."""
ENCODER_STEP = 2 * np.pi / (2**14 * 100)
"""rad."""
CUTOFF = 100.0
"""Hz, of the rates' low-pass."""

Plant = Callable[[Motion], tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]
"""A motion -> the first angles, and what gives the next ones for a torque."""


class Tracked(NamedTuple):
    """Of one law and one motion."""

    rms: float
    """mrad; NaN for a run that is no number."""
    trusted: float = np.nan
    """Share of the samples at which the model was used, for a law that may fall back."""


def in_mujoco(robot: Robot) -> Plant:
    """The arm with dry friction as a constraint; `InputError` where MuJoCo is missing."""
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


def in_equations(robot: Robot) -> Plant:
    """The same tree with a smooth law of dry friction, by the classical Runge-Kutta method."""
    system = dynamics(tree_system(robot.tree, friction_of(robot)))

    @jax.jit
    def after(x: Any, tau: Any) -> Any:
        field = lambda t, x: jnp.concatenate([x[D:], system.forward_dynamics(x[:D], x[D:], tau)])  # noqa: E731
        return runge_kutta(CLASSICAL, field)(0.0, x, STEP)

    def start(wanted: Motion) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
        x = np.concatenate([wanted.q[0], wanted.qd[0]])

        def step(tau: np.ndarray) -> np.ndarray:
            nonlocal x
            x = np.asarray(after(x, tau))
            return x[:D]

        return x[:D], step

    return start


def friction_of(robot: Robot) -> Any:
    """That of the joints, dry friction smooth."""
    return joint_dissipation(robot.damping, robot.coulomb, velocity_scale=USUAL_SCALE)


def track(plant: Plant, law: Tracker | Callable[..., Any], wanted: Motion, samples: int | None = None) -> Tracked:
    """A closed loop along a motion, on the hardware of the head of this file."""

    @jax.jit
    def asked(q: Any, qd: Any, now: Reference) -> Any:
        found = law(q, qd, now)
        tau, usable = found if isinstance(found, tuple) else (found, jnp.asarray(True))
        return limited(where_finite(tau, q, qd), -LIMITS, LIMITS), usable

    q, step = plant(wanted)
    count = len(wanted.q) if samples is None else samples
    share = -np.expm1(-2 * np.pi * CUTOFF * STEP)
    qd, before, late, off, used = np.zeros(D), None, np.asarray(np.zeros(D)), [], 0
    for number in range(count):
        seen = ENCODER_STEP * np.round(q / ENCODER_STEP)
        qd = qd if before is None else qd + share * ((seen - before) / STEP - qd)
        before = seen
        tau, usable = asked(seen, qd, Reference(*(each[number] for each in wanted)))
        off.append(q - wanted.q[number])
        used += bool(usable)
        # A sample late, as are the torques of the start, which hold the arm.
        now, late = (np.asarray(tau) if number == 0 else late), np.asarray(tau)
        q = step(now)
        if not np.isfinite(q).all():
            return Tracked(np.nan, used / (number + 1))
    return Tracked(1e3 * float(np.sqrt(np.mean(np.square(off)))), used / count)
