"""Reads robots from URDF and MJCF files with MuJoCo's compiler (extra `[robot]`): a tree, limits and friction.

Visual and collision geometry is ignored, so meshes may be missing unless a body's mass is derived from its shapes.
"""

import contextlib
import fnmatch
import importlib
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.robot_xml import (
    MOST_JOINTS,
    check_joints,
    link_inertias,
    parse_robot,
    require_range,
    velocity_limits,
    without_shapes,
)
from dln_jax.mechanics.trees.description import Tree, make_tree
from dln_jax.mechanics.trees.inertia import inertial_parameters, moved
from dln_jax.types import InputError, JointVector

INSTALL = "pip install 'dln-jax[robot]'"
Lock = Mapping[str, float] | Sequence[str]
"""Joints that do not move: names, or positions by name, rad or m."""
KINDS = ("free", "a ball", "prismatic", "revolute")
"""MuJoCo's kinds of joints, in the order of their codes."""
EQUAL_JOINTS, OVER_JOINT = 2, 1
"""MuJoCo's codes for equality constraints between joints, and for joints in fixed tendons."""
LARGEST_NUMBER = 1e20
"""Largest admissible number, in SI units."""


class Robot(NamedTuple):
    """A tree with the joint data of its file; missing limits are infinite, and missing friction is zero."""

    tree: Tree
    damping: JointVector
    """Viscous friction, N m s or N s/m."""
    coulomb: JointVector
    """Dry friction, N m or N."""
    position_limits: Float[np.ndarray, "d 2"]
    """rad or m."""
    force_limits: Float[np.ndarray, "d 2"]
    """Limits of the motors, N m or N."""
    velocity_limits: Any = np.inf
    """[d] or one number for all, 1/s or m/s; from URDF only, since MJCF has no such limit."""


def read_robot(path: str | Path, *, lock: Lock = ()) -> Robot:
    """Reads a robot from a URDF or MJCF file, with the extra `[robot]` (MuJoCo).

    URDF inertias are read as stated, even if they are not physically consistent.

    Args:
        path: the URDF or MJCF file.
        lock: joints to lock, for example in a gripper: names (locked at zero), or positions by name, rad or m.
            "*finger*" matches all names that contain finger. Bodies behind a locked joint become fixed.

    Returns:
        The tree of d joints, and viscous and dry friction, limits of position, force and velocity, [d] in SI units.

    Raises:
        InputError: MuJoCo is missing; the file is missing, malformed or cyclic; a joint that is not locked is neither
            revolute, continuous nor prismatic, mimics another, has a spring, or has limits that are NaN, equal,
            swapped or half stated; a joint to lock does not exist; no joint moves; or a moving link has no mass.

    Example:
        >>> import pathlib
        >>> import tempfile
        >>> import dln_jax
        >>> link = '<joint name="hinge" axis="0 1 0" damping="0.1"/><geom size="0.1" mass="2" pos="1 0 0"/>'
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder, "arm.xml")
        ...     _ = file.write_text(f"<mujoco><worldbody><body>{link}</body></worldbody></mujoco>")
        ...     robot = dln_jax.read_robot(file)
        >>> print(robot.tree.names, robot.tree.joints, robot.damping)
        ('hinge',) ('revolute',) [0.1]
    """
    path, root = Path(path), parse_robot(Path(path))
    try:
        stated = link_inertias(root) if root.tag == "robot" else None
        _, model, locked = compile_robot(path, root, lock)
        robot = robot_of(model, locked, stated)
        if stated is None:
            return robot
        speeds = velocity_limits(root)
        return robot._replace(velocity_limits=np.array([speeds.get(name, np.inf) for name in robot.tree.names]))
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None


def compile_robot(
    path: Path, root: ET.Element, lock: Lock, *, inertias: bool = False
) -> tuple[Any, Any, dict[str, float]]:
    """Compiles a file with MuJoCo; returns MuJoCo, its model, and the positions of locked joints by name.

    Shapes of a URDF are left out. Its inertias are placeholders unless `inertias` is true (for simulations), because
    MuJoCo refuses inertias that are not physically consistent. Errors as for `read_robot`.
    """
    refusal = f"{path}: MuJoCo cannot compile it"
    if root.tag == "mujoco":
        mujoco, model = compiled_model(path, refusal)
        locked = _matching(lock, joint_names(model))
        check_joints(path, root, locked)
        require_ranges(model, locked)
        return mujoco, model, locked
    locked = _matching(lock, [joint.get("name", "") for joint in root.findall("joint")])
    check_joints(path, root, locked)
    for joint in root.iter("joint"):
        for mimic in joint.findall("mimic"):
            if joint.get("name") not in locked:
                raise InputError(
                    f"{path}: joint '{joint.get('name')}' follows another joint (mimic); expected independent joints: "
                    "lock both of them"
                )
            joint.remove(mimic)
    source = ET.tostring(without_shapes(root, inertias=inertias), encoding="unicode")
    return (*compiled_model(source, refusal), locked)


def joint_names(model: Any) -> list[str]:
    """Returns the names of a compiled model's joints."""
    return [model.joint(k).name or f"joint_{k}" for k in range(model.njnt)]


def require_ranges(model: Any, locked: Collection[str] = ()) -> None:
    """Raises `InputError` for limits of a compiled joint that are NaN, infinite, equal or swapped.

    MuJoCo keeps the numbers of a range that it does not apply; two zeros mean no range.
    """
    for k, name in enumerate(joint_names(model)):
        for kind, limits in (("position", model.jnt_range[k]), ("torque", model.jnt_actfrcrange[k])):
            if limits.any() and name not in locked:
                require_range(f"joint '{name}'", kind, [f"{limit:.15g}" for limit in limits])


def _matching(lock: Lock, names: Sequence[str]) -> dict[str, float]:
    """Returns the positions of locked joints by full name."""
    positions = lock if isinstance(lock, Mapping) else dict.fromkeys(lock, 0.0)
    locked: dict[str, float] = {}
    for pattern, position in positions.items():
        matching = fnmatch.filter(names, pattern)
        if not matching:
            raise InputError(f"there is no joint '{pattern}' to lock; the joints are {', '.join(names)}")
        locked |= dict.fromkeys(matching, float(position))
    return locked


def compiled_model(source: Any, refusal: str = "MuJoCo refuses the model") -> tuple[Any, Any]:
    """Returns MuJoCo and its model of a file or MJCF text; a `mujoco.MjModel` is returned unchanged.

    Raises:
        InputError: MuJoCo is missing, or cannot compile the source; the message begins with the refusal.
    """
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError:
        raise InputError(f"reading and simulating robots needs MuJoCo, which is not installed; {INSTALL}") from None
    if not isinstance(source, (str, Path)):
        return mujoco, source
    make = mujoco.MjModel.from_xml_string if isinstance(source, str) else mujoco.MjModel.from_xml_path
    try:
        with quiet(mujoco):
            return mujoco, make(str(source))
    except (ValueError, RuntimeError, mujoco.FatalError, mujoco.UnexpectedError) as error:
        raise InputError(f"{refusal}: {' '.join(str(error).split()):.300}") from None


@contextlib.contextmanager
def quiet(mujoco: Any) -> Iterator[None]:
    """Keeps MuJoCo from writing MUJOCO_LOG.TXT into the working folder; its data still counts warnings."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _require_tree(model: Any, names: list[str], locked: Collection[str]) -> None:
    """Raises `InputError` unless every unlocked joint moves freely about or along one axis."""
    for name, kind in zip(names, model.jnt_type, strict=True):
        if KINDS[kind] in ("free", "a ball") and name not in locked:
            raise InputError(
                f"joint '{name}' is {KINDS[kind]}; expected revolute and prismatic joints: lock it if it does not move"
            )
    moving = {k for k, name in enumerate(names) if name not in locked}
    for k in moving & set(np.flatnonzero(model.jnt_stiffness)):
        raise InputError(
            f"joint '{names[k]}' has a spring (stiffness {model.jnt_stiffness[k]:.4g}), but rigid trees have none; "
            "remove the stiffness, or lock the joint"
        )
    # Equality constraints and tendons between locked joints have no effect; tendons without a spring are motors.
    springs = np.repeat((model.tendon_stiffness != 0) | np.asarray(model.tendon_limited, bool), model.tendon_num)
    tied = {int(k) for numbers in (model.eq_obj1id, model.eq_obj2id, model.wrap_objid[springs]) for k in numbers}
    if (model.eq_type != EQUAL_JOINTS).any() or (model.wrap_type != OVER_JOINT).any() or tied & moving:
        raise InputError(
            "it has equality constraints or tendons, which close loops; expected a tree: lock the joints they connect"
        )
    if not 0 < len(moving) <= MOST_JOINTS:
        raise InputError(f"it has {len(moving)} joints; expected 1 to {MOST_JOINTS} that move")


def robot_of(model: Any, locked: Mapping[str, float], stated: Mapping[str, np.ndarray] | None = None) -> Robot:
    """Converts a compiled model to a robot; `stated` inertias of a URDF replace the model's.

    Errors as for `read_robot`.
    """
    names = joint_names(model)
    _require_tree(model, names, locked)
    links: list[tuple[int, str, np.ndarray, np.ndarray, np.ndarray]] = []  # parent, kind, rotation, position, axis
    inertias: list[np.ndarray] = []
    moving: list[int] = []
    # Frame of each body relative to the link it moves with; -1 is the ground.
    carried: list[tuple[int, np.ndarray, np.ndarray]] = [(-1, np.eye(3), np.zeros(3))]
    for body in range(1, model.nbody):
        parent, R, p = carried[model.body_parentid[body]]
        p = p + R @ model.body_pos[body]
        R = R @ _matrix(model.body_quat[body])
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            # The link's frame is at the joint's anchor, the body's frame behind it.
            anchor, axis, kind = model.jnt_pos[joint], np.array(model.jnt_axis[joint]), KINDS[model.jnt_type[joint]]
            position = locked.get(names[joint], 0.0) - model.qpos0[model.jnt_qposadr[joint]]
            if kind == "prismatic":
                p = p + R @ axis * position
            elif kind == "revolute" and position:
                turn = _matrix(np.append(np.cos(position / 2), np.sin(position / 2) * axis))
                p = p + R @ (anchor - turn @ anchor)
                R = R @ turn
            if names[joint] in locked:
                continue
            moving.append(joint)
            links.append((parent, kind, R, p + R @ anchor, axis))
            inertias.append(np.zeros(10))
            parent = len(links) - 1
            R, p = np.eye(3), -anchor
        carried.append((parent, R, p))
        if stated is None:
            turn = _matrix(model.body_iquat[body])
            about = turn @ np.diag(model.body_inertia[body]) @ turn.T
            theta = np.asarray(inertial_parameters(model.body_mass[body], model.body_ipos[body], about))
        else:
            theta = stated.get(model.body(body).name, np.zeros(10))
        if parent >= 0:
            inertias[parent] += moved(theta, R, p)
    names = tuple(names[joint] for joint in moving)
    masses = [theta[0] for theta in inertias]
    for link in reversed(range(len(links))):  # parents come before their children
        if (parent := links[link][0]) >= 0:
            masses[parent] += masses[link]
    if not all(masses):
        name = names[masses.index(0)]
        raise InputError(f"joint '{name}' moves no mass; expected an <inertial> for the link behind it")
    gravity = np.asarray(model.opt.gravity)
    tree = make_tree(
        *zip(*links, strict=True), inertias=inertias, armature=_armature(model, moving), gravity=gravity, names=names
    )
    positions, forces = (
        np.where(np.asarray(limited, bool)[moving, None], limits[moving], [-np.inf, np.inf])
        for limited, limits in (
            (model.jnt_limited, model.jnt_range),
            (model.jnt_actfrclimited, model.jnt_actfrcrange),
        )
    )
    dofs = model.jnt_dofadr[moving]
    robot = Robot(tree, model.dof_damping[dofs], model.dof_frictionloss[dofs], positions, forces)
    _require_numbers(robot)
    return robot


def _armature(model: Any, moving: list[int]) -> np.ndarray:
    """Returns the armature of the moving joints: [d], or [d, d] if fixed tendons have an armature."""
    armature = np.asarray(model.dof_armature[model.jnt_dofadr[moving]], float)
    for tendon in np.flatnonzero(model.tendon_armature):
        wraps = model.tendon_adr[tendon] + np.arange(model.tendon_num[tendon])
        coefficients = np.zeros(model.njnt)
        coefficients[model.wrap_objid[wraps]] = model.wrap_prm[wraps]
        c = coefficients[moving]
        armature = np.diag(armature) if armature.ndim == 1 else armature
        armature = armature + model.tendon_armature[tendon] * np.outer(c, c)
    return armature


def _require_numbers(robot: Robot) -> None:
    """Raises `InputError` for numbers that no real robot has."""
    tree = robot.tree
    armature = tree.armature if np.ndim(tree.armature) == 1 else np.diagonal(tree.armature)
    losses = {"damping": robot.damping, "dry friction": robot.coulomb, "armature": armature}
    frames = {"inertia": tree.inertias, "position": tree.positions, "rotation": tree.rotations, "axis": tree.axes}
    for joint, name in enumerate(tree.names):
        for what, stated in {**frames, "gravity": [tree.gravity] * len(tree.names), **losses}.items():
            numbers = np.ravel(stated[joint])
            least = 0.0 if what in losses else -LARGEST_NUMBER
            if not ((numbers >= least) & (numbers <= LARGEST_NUMBER)).all():
                wanted = "zero or more" if what in losses else f"numbers up to {LARGEST_NUMBER:.0e}"
                shown = ", ".join(f"{number:.3g}" for number in numbers)
                raise InputError(f"the {what} of joint '{name}' is {shown}; expected {wanted}")


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    importlib.import_module("mujoco").mju_quat2Mat(matrix, quaternion)
    return np.where(np.abs(matrix) < 1e-15, 0.0, matrix).reshape(3, 3)
