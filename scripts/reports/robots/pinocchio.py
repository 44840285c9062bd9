"""Times of calls from Python, of exported C and of Pinocchio, a rival in dynamics of rigid bodies.

The rival's regressor of torques, with columns of armature and friction, is fitted by ordinary least squares.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees import Tree, inertial_parameters, serial
from scripts.reports.turns import medians_in_turns

STATES = 256
RIVALS = {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}
"""Pinocchio's functions with the same arguments."""

Torque = Callable[[Any, Any, Any], np.ndarray]
"""q, qd, qdd [N, d] -> tau [N, d]."""


class Timed(NamedTuple):
    """A function of a state of three vectors [d]."""

    function: Callable[..., Any]
    d: int
    dtype: DTypeLike = np.float64
    title: str = ""
    """Name and release of a rival."""


def seconds_of_calls(functions: Mapping[str, Timed], *, repetitions: int) -> dict[str, float]:
    """Times of calls with arrays in and out, s; loops over random states take turns, and medians count."""
    random, loops = np.random.default_rng(0), {}
    for name, (function, d, dtype, _) in functions.items():
        states = random.normal(size=(STATES, 3, d)).astype(dtype)
        loops[name] = partial(call_all, function, [tuple(state) for state in states])
    medians = medians_in_turns(loops, (), repetitions=repetitions)
    return {name: seconds / STATES for name, seconds in medians.items()}


def call_all(function: Callable[..., Any], states: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Calls a function with all states."""
    for state in states:
        function(*state)


def pinocchio() -> Any:
    """The package; prints a line and returns `None` if it is missing."""
    try:
        return importlib.import_module("pinocchio")
    except ImportError:
        print("Pinocchio is missing, and so are its rows; pip install 'dln-jax[reference]'")
        return None


def pinocchio_model(pin: Any, tree: Tree) -> Any:
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
    model, d, release = pinocchio_model(pin, tree), tree.degrees_of_freedom, f"Pinocchio {pin.__version__}"
    call = lambda name: partial(getattr(pin, name), model, model.createData())  # noqa: E731
    return {name: Timed(call(name), d, title=f"{name} of {release}") for name in RIVALS.values()}


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


def regression(tree: Tree, data: Trajectories, *, velocity_scale: Any) -> Torque | None:
    """Pinocchio's regressor with armature, viscous, dry friction and an offset of each joint; `None` without Pinocchio.

    Args:
        tree: tree with known frames.
        data: data to fit, without the test data.
        velocity_scale: velocity scale of dry friction, as in `joint_dissipation`, by joint or one for all.
    """
    if (pin := pinocchio()) is None:
        return None
    model = pinocchio_model(pin, tree)
    of_states, d = model.createData(), tree.degrees_of_freedom

    def columns(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        links = np.array(pin.computeJointTorqueRegressor(model, of_states, q, qd, qdd))
        joints = (np.diag(rates) for rates in (qdd, qd, np.tanh(qd / velocity_scale), np.ones(d)))
        return np.hstack([links, *joints])

    def stacked(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return np.concatenate([columns(*state) for state in zip(*map(np.asarray, (q, qd, qdd)), strict=True)])

    theta = np.linalg.lstsq(stacked(data.q, data.qd, data.qdd), data.tau.ravel(), rcond=1e-10)[0]
    return lambda q, qd, qdd: (stacked(q, qd, qdd) @ theta).reshape(-1, d)
