"""Writes robots: MJCF of any tree, and copies of URDF and MJCF files with identified inertias, armature and friction.

Bodies fixed to a link move with it, so only the sum of their inertias is known. A copy stores this sum in the link
behind the joint and removes the inertias of bodies fixed to it. Quantities that the format cannot store go into a
comment.
"""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.data.robot_xml import MOMENTS, parse_robot, remove
from dln_jax.data.robots import Lock, Robot, compile_robot, joint_names
from dln_jax.files import write_bytes
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.inertia import moved, parts, pseudo_inertia
from dln_jax.mechanics.trees.motors import single_motors
from dln_jax.types import InputError, require_positive

LUMPS = "The inertia of all bodies that move with a joint is in the link behind it; links fixed to that link have none."
Motor = tuple[np.ndarray, dict[str, float]]
"""A motor that turns with several joints: its row of S (motor rate per joint rate), and its constants by name."""
COUPLED = "coupled_motor_"
"""Prefix of the fixed tendons that represent motors coupled to several joints."""


def mjcf(robot: Robot, *, time_step: float = 0.001) -> str:
    """Returns the MJCF text of a robot, with one body per link, one motor per joint and contacts disabled.

    MuJoCo can simulate it, and `read_robot` reads it back.

    Args:
        robot: robot to write; infinite limits are left out.
        time_step: time step of the simulation, s.

    Raises:
        InputError: a link has no mass, or the time step is not positive.
    """
    require_positive(time_step=time_step)
    tree = robot.tree
    names = tree.names or tuple(f"joint_{link}" for link in range(tree.degrees_of_freedom))
    root = ET.Element("mujoco")
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    settings = {"gravity": _text(tree.gravity), "timestep": _text(time_step), "integrator": "implicitfast"}
    ET.SubElement(ET.SubElement(root, "option", settings), "flag", contact="disable")
    world, motors = ET.SubElement(root, "worldbody"), ET.SubElement(root, "actuator")
    bodies: list[ET.Element] = []
    armature, coupled = _motors(tree)
    numbers = {"armature": armature, "damping": robot.damping, "frictionloss": robot.coulomb}
    for link, (name, parent) in enumerate(zip(names, tree.parents, strict=True)):
        theta, turn = np.asarray(tree.inertias[link], float), np.asarray(tree.rotations[link])
        if not theta[0] > 0:
            raise InputError(
                f"the link of joint '{name}' has a mass of {theta[0]:.3g} kg; expected a positive one in MJCF"
            )
        place = {"name": f"link_{name}", "pos": _text(tree.positions[link])}
        if not np.array_equal(turn, np.eye(3)):
            place["xyaxes"] = _text(turn[:, :2].T)  # the first two columns keep all digits
        bodies.append(ET.SubElement(bodies[parent] if parent >= 0 else world, "body", place))
        bodies[-1].append(_mjcf_inertial(theta))
        stated = {key: _text(values[link]) for key, values in numbers.items()}
        for key, limits in (("range", robot.position_limits[link]), ("actuatorfrcrange", robot.force_limits[link])):
            if np.isfinite(limits).all():
                stated[key] = _text(limits)
        kind = "hinge" if tree.joints[link] == "revolute" else "slide"
        ET.SubElement(bodies[-1], "joint", {"name": name, "type": kind, "axis": _text(tree.axes[link]), **stated})
        ET.SubElement(motors, "motor", name=f"motor_{name}", joint=name)
    _tendons(root, names, coupled)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def write_robot(
    path: str | Path,
    original: str | Path,
    tree: Tree,
    *,
    damping: Any = None,
    coulomb: Any = None,
    motors: Any = None,
    lock: Lock = (),
    remarks: tuple[str, ...] = (),
) -> None:
    """Writes a copy of `original` with the inertias and friction of a tree, and its armature if the format has it.

    In MJCF, fixed tendons represent an armature matrix and the friction of motors coupled to several joints. URDF
    cannot store them, so a comment states them.

    Args:
        path: the new file.
        original: URDF or MJCF file with the tree's structure; it stays unchanged.
        tree: tree with the same joint names.
        damping: viscous friction of each joint (or motor) [d], N m s or N s/m (default: unchanged).
        coulomb: dry friction [d], N m or N (default: unchanged).
        motors: matrix S [d, d] of motor rates S qd; friction acts at the motors (default: one motor per joint).
        lock: joints that were locked when the tree was read, as for `read_robot`. Bodies behind a locked joint belong
            to the link before it, at the locked position.
        remarks: lines of the comment at the top of the file.

    Raises:
        InputError: the tree has other joints, a link is not physically consistent, an MJCF file includes or repeats
            elements or has locked joints, `path` is `original`, or `read_robot` refuses the original.
    """
    path, original = Path(path), Path(original)
    if path.exists() and original.exists() and path.samefile(original):
        raise InputError(f"{path} is the original file; choose another name")
    root = parse_robot(original)
    _, model, locked = compile_robot(original, copy.deepcopy(root), lock)
    names = [name for name in joint_names(model) if name not in locked]
    if list(tree.names) != names:
        raise InputError(f"{original} has the joints {', '.join(names)}; the tree has {', '.join(tree.names)}")
    for name, theta in zip(names, np.asarray(tree.inertias, float), strict=True):
        if theta.any() and np.linalg.eigvalsh(pseudo_inertia(theta))[0] <= 0:
            raise InputError(f"the link behind joint '{name}' is not physically consistent; correct its inertia")
    comment = [LUMPS, *remarks]
    if locked:
        where = ", ".join(f"{name} at {position!r}" for name, position in locked.items())
        comment.append(f"Locked during identification, and part of the link before (rad or m): {where}.")
    losses = {key: values for key, values in (("damping", damping), ("frictionloss", coulomb)) if values is not None}
    armature, coupled = _motors(tree)
    losses, others = _split(motors, losses)
    coupled = [*others, *coupled]
    if root.tag == "robot":
        if np.any(armature):
            numbers = ", ".join(f"{name} {_text(value)}" for name, value in zip(names, armature, strict=True))
            comment.append(f"Armature, which URDF cannot state (kg m² or kg): {numbers}.")
        for coefficients, constants in coupled:
            speed = " + ".join(f"{_text(c)} {name}" for c, name in zip(coefficients, names, strict=True) if c)
            stated = ", ".join(f"{key} {_text(value)}" for key, value in constants.items())
            comment.append(f"URDF cannot state the motor that turns at {speed}: {stated}.")
        _into_urdf(root, model, tree, locked, losses)
    else:
        if locked:
            raise InputError(
                f"{original}: bodies behind locked joints of an MJCF file would have no mass; remove these joints"
            )
        _into_mjcf(original, root, model, tree, {"armature": armature, **losses})
        _tendons(root, names, coupled)
    top = ET.Comment("\n  " + "\n  ".join(line.replace("--", "- -") for line in comment) + "\n")
    top.tail = "\n"
    root.insert(0, top)
    write_bytes(path, ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _into_urdf(
    root: ET.Element, model: Any, tree: Tree, locked: Collection[str], losses: Mapping[str, np.ndarray]
) -> None:
    links, joints = ({part.get("name"): part for part in root.findall(tag)} for tag in ("link", "joint"))
    for body in _moving(model, locked):
        remove(links[model.body(body).name], "inertial")
    for k, name in enumerate(tree.names):
        mass, centre, about = _about_centre(np.asarray(tree.inertias[k], float))
        inertial = ET.Element("inertial")
        ET.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=_text(mass))
        moments = zip(np.ravel(MOMENTS), about.ravel(), strict=True)
        ET.SubElement(inertial, "inertia", {key: _text(moment) for key, moment in moments})
        body = model.jnt_bodyid[model.joint(name).id]
        links[model.body(body).name].insert(0, inertial)
        for key, values in losses.items():
            dynamics = joints[name].find("dynamics")
            dynamics = ET.SubElement(joints[name], "dynamics") if dynamics is None else dynamics
            dynamics.set("friction" if key == "frictionloss" else key, _text(values[k]))


def _into_mjcf(original: Path, root: ET.Element, model: Any, tree: Tree, constants: Mapping[str, np.ndarray]) -> None:
    for element in root.iter():
        if element.tag in ("include", "replicate", "attach", "composite", "flexcomp", "model"):
            raise InputError(
                f"{original} has <{element.tag}> with bodies from elsewhere; expected a single file, as MuJoCo saves it"
            )
    for compiler in root.findall("compiler"):
        # These settings would alter the inertias written below.
        for name in ("inertiafromgeom", "settotalmass", "boundmass", "boundinertia", "balanceinertia"):
            compiler.attrib.pop(name, None)
    bodies = [body for world in root.findall("worldbody") for body in world.iter("body")]  # in MuJoCo's order
    for body in _moving(model):
        element = bodies[body - 1]
        remove(element, "inertial")
        inertial = ET.Element("inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
        for k, joint in enumerate(_joints(element), model.body_jntadr[body]):
            theta = np.asarray(tree.inertias[k], float)
            if theta.any():
                # Move the parameters from the joint's anchor, the origin of the link's frame, to the body's frame.
                inertial = _mjcf_inertial(np.asarray(moved(theta, np.eye(3), model.jnt_pos[k])))
            joint.set("name", tree.names[k])  # tendons name their joints
            for key, values in constants.items():
                joint.set(key, _text(values[k]))
        element.insert(0, inertial)


def _moving(model: Any, locked: Collection[str] = ()) -> list[int]:
    """Returns the bodies of a compiled model that move with an unlocked joint."""
    free = {model.jnt_bodyid[k] for k, name in enumerate(joint_names(model)) if name not in locked}
    moving: list[int] = []
    for body in range(1, model.nbody):  # parents come before their children
        if body in free or model.body_parentid[body] in moving:
            moving.append(body)
    return moving


def _joints(element: ET.Element) -> Iterator[ET.Element]:
    """Yields the joints of an MJCF body, including its frames."""
    for part in element:
        if part.tag == "joint":
            yield part
        elif part.tag == "frame":
            yield from _joints(part)


def _motors(tree: Tree) -> tuple[np.ndarray, list[Motor]]:
    """Returns the armatures of the joints, and the motors coupled to several joints."""
    armature, coupled = single_motors(tree.armature)
    return armature, [(coefficients, {"armature": inertia}) for inertia, coefficients in coupled]


def _split(motors: Any, losses: dict[str, Any]) -> tuple[dict[str, Any], list[Motor]]:
    """Separates the friction of joints with their own motor from the friction of coupled motors."""
    if motors is None:
        return losses, []
    S = np.asarray(motors, float)
    own = (np.eye(len(S)) == S).all(axis=1)
    others = [
        (S[k], {key: float(values[k]) for key, values in losses.items()})
        for k in np.flatnonzero(~own)
        if any(values[k] for values in losses.values())
    ]
    return {key: np.where(own, values, 0.0) for key, values in losses.items()}, others


def _tendons(root: ET.Element, names: Sequence[str], motors: Sequence[Motor]) -> None:
    """Replaces the fixed tendons of coupled motors by name; other tendons lose their armature to the motors."""
    group = root.find("tendon")
    for tendons in root.findall("tendon"):
        for tendon in tendons.findall("fixed"):
            tendon.attrib.pop("armature", None)
            if (tendon.get("name") or "").startswith(COUPLED):
                tendons.remove(tendon)
    for number, (coefficients, constants) in enumerate(motors, 1):
        group = ET.SubElement(root, "tendon") if group is None else group
        numbers = {key: _text(value) for key, value in constants.items()}
        tendon = ET.SubElement(group, "fixed", {"name": f"{COUPLED}{number}", **numbers})
        for name, coefficient in zip(names, coefficients, strict=True):
            if coefficient:
                ET.SubElement(tendon, "joint", joint=name, coef=_text(coefficient))


def _mjcf_inertial(theta: np.ndarray) -> ET.Element:
    mass, centre, about = _about_centre(theta)
    moments = _text([*np.diag(about), *about[np.triu_indices(3, 1)]])
    return ET.Element("inertial", mass=_text(mass), pos=_text(centre), fullinertia=moments)


def _about_centre(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Returns the mass, the centre of mass, and the moments of inertia about it."""
    m, h, moments = parts(theta)
    centre = h / m
    return float(m), centre, moments - m * (centre @ centre * np.eye(3) - centre[:, None] * centre)


def _text(numbers: Any) -> str:
    """Formats numbers with the fewest digits that read back exactly."""
    return " ".join(map(repr, np.ravel(np.asarray(numbers, float)).tolist()))
