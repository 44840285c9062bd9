"""Robots from URDF and MJCF files, read by MuJoCo's compiler (extra `[robot]`): a tree, limits and friction.

What is seen or collides is not read: meshes need not be there, unless a body's mass comes from its shapes alone.
"""

import contextlib
import importlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.mechanics.trees.description import Tree, make_tree
from dln_jax.mechanics.trees.inertia import inertial_parameters, moved
from dln_jax.types import InputError

INSTALL = "pip install 'dln-jax[robot]'"
LARGEST = 64 * 2**20
"""Bytes of a file."""
MOST_JOINTS = 200


class Robot(NamedTuple):
    """A tree, and what else its file states of each joint; what it does not state is infinite, or zero for friction."""

    tree: Tree
    damping: Float[np.ndarray, " d"]
    """Viscous friction, N m s or N s/m."""
    coulomb: Float[np.ndarray, " d"]
    """Dry friction, N m or N."""
    position_limits: Float[np.ndarray, "d 2"]
    """rad or m."""
    force_limits: Float[np.ndarray, "d 2"]
    """N m or N, of the motors."""
    velocity_limits: Any = np.inf
    """[d], 1/s or m/s, or one for all; a URDF states them, MJCF cannot."""


class _Link(NamedTuple):
    parent: int
    kind: str
    rotation: np.ndarray
    position: np.ndarray
    axis: np.ndarray


def read_robot(path: str | Path) -> Robot:
    """The robot of a URDF or MJCF file.

    Raises:
        InputError: MuJoCo is missing; the file is not there, broken or cyclic; a joint is of another kind than
            revolute, continuous or prismatic, or follows another; nothing moves; or a link that moves has no mass.
    """
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError:
        raise InputError(f"MuJoCo reads robots and is missing; {INSTALL}") from None
    path = Path(path)
    if not path.is_file() or path.stat().st_size > LARGEST:
        raise InputError(f"{path}: no file of up to {LARGEST >> 20} MiB; give one of a robot, URDF or MJCF")
    content = path.read_bytes()
    if b"<!ENTITY" in content:
        raise InputError(f"{path}: it defines entities, which can grow without bound; expected plain XML")
    try:
        root = ET.fromstring(content)
    except ET.ParseError as error:
        raise InputError(f"{path}: no XML ({error}); expected a URDF or MJCF file") from None
    if root.tag not in ("robot", "mujoco"):
        raise InputError(f"{path}: its outer element is <{root.tag}>; expected <robot> (URDF) or <mujoco> (MJCF)")
    try:
        model = _compiled(mujoco, path, root)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: MuJoCo cannot compile it: {reason:.300}") from None
    try:
        robot = _robot(mujoco, model)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return robot._replace(velocity_limits=_velocity_limits(root, robot.tree.names))


def _velocity_limits(root: ET.Element, names: tuple[str, ...]) -> np.ndarray:
    """What <limit velocity="..."> of each joint says, which MuJoCo does not read; infinite where it says nothing."""
    stated = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        velocity = "" if limit is None else limit.get("velocity", "")
        with contextlib.suppress(ValueError):
            stated[joint.get("name")] = float(velocity)
    # Some files write 0 for what nobody knows.
    return np.array([stated[name] if stated.get(name, 0.0) > 0 else np.inf for name in names])


def _compiled(mujoco: Any, path: Path, root: ET.Element) -> Any:
    if root.tag == "robot":
        for joint in root.iter("joint"):
            if joint.find("mimic") is not None:
                raise InputError(
                    f"{path}: joint '{joint.get('name')}' follows another (mimic); expected joints that move freely"
                )
        for link in root.iter("link"):
            for shape in [*link.findall("visual"), *link.findall("collision")]:
                link.remove(shape)
        return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    return mujoco.MjModel.from_xml_path(str(path))


def _robot(mujoco: Any, model: Any) -> Robot:
    names = [model.joint(k).name or f"joint_{k}" for k in range(model.njnt)]
    kinds = {int(mujoco.mjtJoint.mjJNT_HINGE): "revolute", int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic"}
    others = {int(mujoco.mjtJoint.mjJNT_BALL): "a ball", int(mujoco.mjtJoint.mjJNT_FREE): "free"}
    for name, kind in zip(names, map(int, model.jnt_type), strict=True):
        if kind in others:
            raise InputError(f"joint '{name}' is {others[kind]}; expected revolute and prismatic joints")
    if model.neq or model.ntendon:
        raise InputError("it has equality constraints or tendons, which close loops; expected a tree")
    if not 0 < model.njnt <= MOST_JOINTS:
        raise InputError(f"it has {model.njnt} joints; expected 1 to {MOST_JOINTS} that move")
    links: list[_Link] = []
    inertias: list[np.ndarray] = []
    # Frame of each body in that of the link that it moves with, -1 for the ground.
    carried: list[tuple[int, np.ndarray, np.ndarray]] = [(-1, np.eye(3), np.zeros(3))]
    for body in range(1, model.nbody):
        parent, R, p = carried[model.body_parentid[body]]
        p = p + R @ model.body_pos[body]
        R = R @ _matrix(mujoco, model.body_quat[body])
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            # The link's frame is at the joint; the body's is behind it.
            anchor = model.jnt_pos[joint]
            axis = np.array(model.jnt_axis[joint])
            links.append(_Link(parent, kinds[int(model.jnt_type[joint])], R, p + R @ anchor, axis))
            inertias.append(np.zeros(10))
            parent = len(links) - 1
            R, p = np.eye(3), -anchor
        carried.append((parent, R, p))
        if parent >= 0 and model.body_mass[body] > 0:
            turn = _matrix(mujoco, model.body_iquat[body])
            about = turn @ np.diag(model.body_inertia[body]) @ turn.T
            theta = inertial_parameters(model.body_mass[body], model.body_ipos[body], about)
            inertias[parent] = inertias[parent] + moved(theta, R, p)
    for link, name in enumerate(names):
        if not _moves_mass(links, inertias, link):
            raise InputError(f"joint '{name}' moves no mass; expected an <inertial> for the link behind it")
    parents, joints, rotations, positions, axes = zip(*links, strict=True)
    tree = make_tree(
        parents, joints, rotations, positions, axes, inertias,
        armature=np.asarray(model.dof_armature), gravity=np.asarray(model.opt.gravity), names=names,
    )  # fmt: skip
    inside = np.array([-np.inf, np.inf])
    ranges = np.where(np.asarray(model.jnt_limited, bool)[:, None], model.jnt_range, inside)
    forces = np.where(np.asarray(model.jnt_actfrclimited, bool)[:, None], model.jnt_actfrcrange, inside)
    return Robot(tree, np.array(model.dof_damping), np.array(model.dof_frictionloss), ranges, forces)


def _moves_mass(links: list[_Link], inertias: list[np.ndarray], link: int) -> bool:
    """Whether a link or one that hangs on it has mass."""
    behind = {link}
    for other, each in enumerate(links):
        if each.parent in behind:
            behind.add(other)
    return any(inertias[each][0] > 0 for each in behind)


def _matrix(mujoco: Any, quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return np.where(np.abs(matrix) < 1e-15, 0.0, matrix).reshape(3, 3)
