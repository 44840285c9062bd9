"""A seven-axis arm simulated in MuJoCo, with the logs that an engineer would have, and Pinocchio's model of such arms.

The frames are a Panda's. Masses and centres are similar to its own; moments of
inertia are those of ellipsoids about the centre. Motors have armature; joints have viscous and optionally dry friction.
MuJoCo treats dry friction as a constraint, so none of our laws is exact. A PD controller at 1 kHz follows Fourier
series; logs have 125 samples per second, with noise on encoders and torques. Pinocchio is a rival in dynamics of rigid
bodies: its functions, and a regression by it.
"""

import functools
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import DTypeLike

from dln_jax import Model, tree_system
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot, compiled_model
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees.description import Tree, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.metrics.errors import normalised_error
from dln_jax.models.model import Parameters
from scripts.reports.robots.simulated_arms import CENTRES, MASSES, panda
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

D = 7
SPREADS = (
    (0.08, 0.08, 0.04),
    (0.05, 0.05, 0.04),
    (0.06, 0.06, 0.04),
    (0.06, 0.06, 0.05),
    (0.09, 0.08, 0.03),
    (0.04, 0.04, 0.04),
    (0.03, 0.03, 0.03),
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


STATES = 256
RIVALS = {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}
"""Pinocchio's functions with the same arguments."""


class Timed(NamedTuple):
    """A function of a state of three vectors [d]."""

    function: Callable[..., Any]
    d: int
    dtype: DTypeLike = np.float64


def speed(*, repetitions: int = 200) -> Numbers:
    """Time of a call from Python in C and in Pinocchio, for a seven-axis tree."""
    tree = arm(coulomb=False).tree
    system = tree_system(tree)
    exported = functions_of_system(system, D, dtype=np.float64)
    # Without armature: ours adds it, and Pinocchio does a little less.
    rivals = pinocchio_functions(tree)
    with tempfile.TemporaryDirectory() as place:
        export_c({name: exported[name] for name in RIVALS}, Path(place) / "arm")
        loaded = load_c(Path(place) / "arm")
        ours = {name: Timed(getattr(loaded, name), D) for name in RIVALS}
        seconds = seconds_of_calls({**ours, **rivals}, repetitions=repetitions)
    numbers = {}
    for name, rival in RIVALS.items():
        times = {"python_us": 1e6 * seconds[name]}
        if rivals:
            times |= {"pinocchio_us": 1e6 * seconds[rival], f"over_{rival}": seconds[name] / seconds[rival]}
        numbers[f"seven-axis-tree/{name}"] = times
    return numbers


def seconds_of_calls(functions: Mapping[str, Timed], *, repetitions: int) -> dict[str, float]:
    """Times of calls with arrays in and out, s; loops over random states take turns, and medians count."""
    random, loops = np.random.default_rng(0), {}
    for name, (function, d, dtype) in functions.items():
        states = random.normal(size=(STATES, 3, d)).astype(dtype)
        loops[name] = partial(call_all, function, [tuple(state) for state in states])
    medians = medians_in_turns(loops, (), repetitions=repetitions)
    return {name: seconds / STATES for name, seconds in medians.items()}


def call_all(function: Callable[..., Any], states: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Calls a function with all states."""
    for state in states:
        function(*state)


def pinocchio():
    """The package; prints a line and returns `None` if it is missing."""
    try:
        import pinocchio as pin  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("Pinocchio is missing, and so are its rows; pip install 'dln-jax[reference]'")
        return None
    return pin


def pinocchio_model(pin, tree: Tree):
    """The same tree, without armature."""
    model = pin.Model()
    model.gravity.linear = np.asarray(tree.gravity)
    # Pinocchio has a faster model for joints about z.
    along_z = {"revolute": pin.JointModelRZ, "prismatic": pin.JointModelPZ}
    others = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    for link, parent in enumerate(tree.parents):
        place = pin.SE3(np.asarray(tree.rotations[link]), np.asarray(tree.positions[link]))
        kind, axis = tree.joints[link], np.asarray(tree.axes[link], float)
        joint = along_z[kind]() if np.array_equal(axis, [0, 0, 1]) else others[kind](axis)
        added = model.addJoint(parent + 1, joint, place, f"joint_{link}")
        m, hx, hy, hz, xx, xy, xz, yy, yz, zz = np.asarray(tree.inertias[link])
        # Pinocchio's order of the same ten numbers.
        inertia = pin.Inertia.FromDynamicParameters(np.array([m, hx, hy, hz, xx, xy, yy, xz, yz, zz]))
        model.appendBodyToJoint(added, inertia, pin.SE3.Identity())
    return model


def pinocchio_functions(tree: Tree) -> dict[str, Timed]:
    """Pinocchio's inverse and forward dynamics of a tree without armature; none if the package is missing."""
    if (pin := pinocchio()) is None:
        return {}
    model = pinocchio_model(pin, tree)
    return {
        name: Timed(partial(getattr(pin, name), model, model.createData()), tree.degrees_of_freedom)
        for name in RIVALS.values()
    }


def rival_arm(d: int) -> Tree:
    """An arm of d revolute joints about the z axes of random frames, which Pinocchio handles fastest."""
    random = np.random.default_rng(2)
    turns = np.linalg.qr(random.normal(size=(d, 3, 3)))[0]
    rotations = turns * np.sign(np.linalg.det(turns))[:, None, None]
    links = [
        inertial_parameters(random.uniform(1.0, 3.0), 0.1 * random.normal(size=3), np.diag(random.uniform(1, 1.5, 3)))
        for _ in range(d)
    ]
    return serial(rotations, 0.3 * random.normal(size=(d, 3)), links)


def regression(tree: Tree, data: Trajectories, velocity_scale) -> Torque | None:
    """Least squares by Pinocchio's regressor with armature, viscous, dry friction and an offset of each joint.

    `velocity_scale` is that of `joint_dissipation`, by joint or one for all. `None` without Pinocchio.
    """
    if (pin := pinocchio()) is None:
        return None
    model = pinocchio_model(pin, tree)
    of_states, d = model.createData(), tree.degrees_of_freedom

    def stacked(*states):
        rows = []
        for q, qd, qdd in zip(*map(np.asarray, states), strict=True):
            joints = (np.diag(rates) for rates in (qdd, qd, np.tanh(qd / velocity_scale), np.ones(d)))
            rows.append(np.hstack([pin.computeJointTorqueRegressor(model, of_states, q, qd, qdd), *joints]))
        return np.concatenate(rows)

    theta = np.linalg.lstsq(stacked(data.q, data.qd, data.qdd), data.tau.ravel(), rcond=1e-10)[0]
    return lambda *states: (stacked(*states) @ theta).reshape(-1, d)
