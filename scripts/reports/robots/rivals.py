"""The rival: Pinocchio's regressor of torques, with columns of armature and friction, by ordinary least squares."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees import Tree

INSTALL = "pip install 'dln-jax[reference]'"


class Regression(NamedTuple):
    """A fitted rival."""

    theta: Float[np.ndarray, " P"]
    torque: Callable[[Any, Any, Any], np.ndarray]
    """q, qd, qdd, each [N, d] -> tau [N, d]."""


def pinocchio() -> Any:
    """The package; prints a line and returns `None` if it is missing."""
    try:
        return importlib.import_module("pinocchio")
    except ImportError:
        print(f"Pinocchio is missing, and so are its rows; {INSTALL}")
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


def regression(tree: Tree, data: Trajectories, *, velocity_scale: Any) -> Regression | None:
    """Pinocchio's regressor with armature, viscous, dry friction and an offset of each joint; `None` without Pinocchio.

    Args:
        tree: tree with known frames.
        data: data to fit, without the test data.
        velocity_scale: velocity scale of dry friction, as in `joint_dissipation`, by joint or one for all.
    """
    pin = pinocchio()
    if pin is None:
        return None
    model = pinocchio_model(pin, tree)
    of_states, d = model.createData(), tree.degrees_of_freedom

    def columns(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        links = np.array(pin.computeJointTorqueRegressor(model, of_states, q, qd, qdd))
        joints = (np.diag(each) for each in (qdd, qd, np.tanh(qd / velocity_scale), np.ones(d)))
        return np.hstack([links, *joints])

    def stacked(q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        return np.concatenate([columns(*state) for state in zip(*map(np.asarray, (q, qd, qdd)), strict=True)])

    theta = np.linalg.lstsq(stacked(data.q, data.qd, data.qdd), data.tau.ravel(), rcond=1e-10)[0]
    return Regression(theta, lambda q, qd, qdd: (stacked(q, qd, qdd) @ theta).reshape(-1, d))
