"""A seven-axis arm simulated in MuJoCo, with the logs that an engineer would have.

The frames are a Panda's. Masses and centres are similar to its own; moments of
inertia are those of ellipsoids about the centre. Motors have armature; joints have viscous and optionally dry friction.
MuJoCo treats dry friction as a constraint, so none of our laws is exact. A PD controller at 1 kHz follows Fourier
series; logs have 125 samples per second, with noise on encoders and torques.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.data import Robot, Trajectories
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import compiled_model
from dln_jax.data.schema import from_arrays
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import inertial_parameters, serial
from dln_jax.metrics.errors import normalised_error
from dln_jax.models import Model, Parameters
from scripts.reports.robots.simulated_arms import CENTRES, MASSES, panda

D = 7
SPREADS = (
    *((0.08, 0.08, 0.04), (0.05, 0.05, 0.04), (0.06, 0.06, 0.04), (0.06, 0.06, 0.05)),
    *((0.09, 0.08, 0.03), (0.04, 0.04, 0.04), (0.03, 0.03, 0.03)),
)
"""Standard deviations of the mass along axes through the centre, m."""
ARMATURE = (0.2, 0.2, 0.2, 0.2, 0.07, 0.07, 0.07)
"""Armature of the motors, kg m²."""
VISCOUS = (1.0, 1.0, 0.8, 0.8, 0.4, 0.3, 0.2)
"""Viscous friction, N m s."""
COULOMB = (1.0, 1.2, 0.8, 0.8, 0.5, 0.4, 0.3)
"""Dry friction, N m."""
STIFFNESS = np.array([600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0])
"""Proportional gains of the PD controller, N m/rad."""
DAMPING = np.array([50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0])
"""Derivative gains, N m s/rad."""
MIDDLE = np.array([0.0, 0.0, 0.0, -1.5, 0.0, 1.9, 0.0])
REACH = np.array([1.4, 0.9, 1.4, 0.75, 1.4, 0.95, 1.4])
"""Half the range of motions about the middle, rad."""
HARMONICS, PERIOD = 5, 10.0
STEP, EVERY = 0.001, 8
"""Time step of the controller, s, and number of its steps per logged sample."""
ENCODER_NOISE = 1e-4
"""Standard deviation of the noise on angles, rad."""
TORQUE_NOISE = np.array([0.5, 0.5, 0.4, 0.4, 0.2, 0.1, 0.1])
"""Standard deviations of the noise on torques, N m."""


Torque = Callable[[Any, Any, Any], np.ndarray]
"""q, qd, qdd [N, d] -> tau [N, d]."""


class Motion(NamedTuple):
    """References of a motion for T steps of the controller; fields [T, d]."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def arm(*, coulomb: bool) -> Robot:
    """The arm, with or without dry friction."""
    links = [
        inertial_parameters(m, c, m * (np.sum(np.square(s)) * np.eye(3) - np.diag(np.square(s))))
        for m, c, s in zip(np.round(MASSES, 2), np.round(CENTRES, 3), SPREADS, strict=True)
    ]
    frames = panda().tree
    tree = serial(frames.rotations, frames.positions, links, armature=np.array(ARMATURE))
    free = np.tile([-np.inf, np.inf], (D, 1))
    return Robot(tree, np.array(VISCOUS), np.array(COULOMB) * coulomb, free, free)


def motion(random: np.random.Generator) -> Motion:
    """A random Fourier series within the reach of every joint, over one period, starting and ending at rest."""
    t = STEP * np.arange(int(PERIOD / STEP))
    frequencies = 2 * np.pi / PERIOD * np.arange(1, HARMONICS + 1)
    sines, cosines = random.uniform(-1, 1, (2, D, HARMONICS)) / np.arange(1, HARMONICS + 1) ** 0.5
    angles = frequencies[:, None] * t
    # A window over the first and last second lets every motion begin and end at rest.
    rise = np.clip(np.minimum(t, PERIOD - t), 0, 1)
    window = rise**3 * (10 - 15 * rise + 6 * rise**2)
    series = (sines @ np.sin(angles) + cosines @ np.cos(angles)).T * window[:, None]
    largest = np.abs(series).max(axis=0)
    q = MIDDLE + series * REACH * random.uniform(0.6, 1.0, D) / largest
    qd = np.gradient(q, STEP, axis=0, edge_order=2)
    return Motion(q, qd, np.gradient(qd, STEP, axis=0, edge_order=2))


def follow(robot: Robot, wanted: Motion, feed_forward: np.ndarray | None = None) -> np.ndarray:
    """Runs the arm in MuJoCo under PD control, with optional feed-forward torques [T, d].

    Returns q, qd, qdd, the motors' tau and the reference of every eighth step [5, N, d], without noise.
    """
    mujoco, model, data = simulator(robot)
    data.qpos[:], data.qvel[:] = wanted.q[0], wanted.qd[0]
    # The simulation's rates belong to its last step, half a step behind its coordinates.
    rates = np.diff(wanted.q, axis=0, prepend=wanted.q[:1]) / STEP
    logged = []
    for step, (q, qd) in enumerate(zip(wanted.q, rates, strict=True)):
        tau = STIFFNESS * (q - data.qpos) + DAMPING * (qd - data.qvel)
        data.ctrl[:] = tau if feed_forward is None else tau + feed_forward[step]
        mujoco.mj_forward(model, data)
        if step % EVERY == 0:
            logged.append(np.stack([data.qpos, data.qvel, data.qacc, data.ctrl, q]))
        mujoco.mj_step(model, data)
    return np.stack(logged, axis=1)


def exact_torque(robot: Robot, wanted: Motion) -> np.ndarray:
    """Torques [T, d] along the references by MuJoCo's inverse dynamics, including dry friction."""
    mujoco, model, data = simulator(robot)
    tau = []
    for state in zip(*wanted, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        tau.append(np.array(data.qfrc_inverse))
    return np.stack(tau)


def simulator(robot: Robot) -> tuple[Any, Any, Any]:
    """MuJoCo, its model of the arm, and a state."""
    mujoco, model = compiled_model(mjcf(robot, time_step=STEP))
    return mujoco, model, mujoco.MjData(model)


def logs(robot: Robot, random: np.random.Generator, count: int) -> Trajectories:
    """Noise-free logs of random motions under PD control."""
    recorded = np.stack([follow(robot, motion(random))[:4] for _ in range(count)], axis=1)
    samples = recorded.shape[2]
    arrays = dict(zip(("q", "qd", "qdd", "tau"), recorded.reshape(4, -1, D), strict=True))
    t = np.tile(STEP * EVERY * np.arange(samples), count)
    return from_arrays({"t": t, "trajectory": np.repeat(np.arange(count), samples), **arrays})


def measured(data: Trajectories, random: np.random.Generator) -> dict[str, np.ndarray]:
    """A realistic log by the keys of the schema: noisy encoder angles and motor torques, without rates."""
    return {
        "t": data.t,
        "q": data.q + random.normal(size=data.q.shape) * ENCODER_NOISE,
        "tau": data.tau + random.normal(size=data.tau.shape) * TORQUE_NOISE,
        "trajectory": data.trajectory,
        "label": data.label,
    }


def torque_of(model: Model, parameters: Parameters) -> Torque:
    """The inverse dynamics of a model for many states."""
    program = torque_program(model)
    return lambda *states: np.asarray(program(parameters, *states))


@functools.lru_cache(maxsize=4)
def torque_program(model: Model) -> Callable[..., Any]:
    """(parameters, q, qd, qdd) -> torques of many states, one program for all parameters."""
    return jax.jit(lambda parameters, *x: jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*x))


def error_of(torque: Torque, test: Trajectories) -> np.ndarray:
    """nMSE by joint [d]."""
    return normalised_error(torque(test.q, test.qd, test.qdd), test.tau)
