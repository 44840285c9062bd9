"""Writes URDF and MJCF files with identified inertias, armature and friction in place of the original ones.

Bodies fixed to a link move with it, and only their sum is known. It is written into the link that the joint moves, and
the inertias of bodies fixed to that link are removed. Quantities that the format cannot store go into a comment.
"""

import copy
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.data.robot_xml import parsed
from dln_jax.data.robots import joint_names, opened
from dln_jax.data.urdf import MOVING
from dln_jax.files import write_bytes
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.inertia import moved, parts, pseudo_inertia
from dln_jax.types import InputError

LUMPS = "Inertias are of all that moves with a joint: in the link behind it, none in links that are fixed to that."


def write_robot(
    path: str | Path,
    original: str | Path,
    tree: Tree,
    *,
    damping: Any = None,
    coulomb: Any = None,
    lock: Mapping[str, float] | Sequence[str] = (),
    remarks: tuple[str, ...] = (),
) -> None:
    """Writes a copy of `original` with the inertias and friction of a tree, and its armature if the format has it.

    Args:
        path: path of the new file.
        original: URDF or MJCF file from which the tree's structure was read; it stays unchanged.
        tree: tree with the joints of that file, by name.
        damping: viscous friction of each joint [d], N m s or N s/m; by default unchanged.
        coulomb: dry friction [d], N m or N; by default unchanged.
        lock: joints that were locked when the tree was read, as for `read_robot`. The bodies behind a locked joint
            count towards the link before it, in the position in which the joint is locked.
        remarks: lines of the comment at the top of the file.

    Raises:
        InputError: the tree has other joints, a link is not physically consistent, an MJCF file includes or repeats
            elements or has locked joints, `path` is `original`, or as `read_robot`.
    """
    path, original = Path(path), Path(original)
    if path.exists() and original.exists() and path.samefile(original):
        raise InputError(f"{path} is the file that was read; give another name, so that it stays as it is")
    root = parsed(original)
    _, model, held = opened(original, copy.deepcopy(root), lock)
    names = [name for name in joint_names(model) if name not in held]
    if list(tree.names) != names:
        raise InputError(f"{original} has the joints {', '.join(names)}; the tree has {', '.join(tree.names)}")
    for name, theta in zip(names, np.asarray(tree.inertias, float), strict=True):
        if theta.any() and np.linalg.eigvalsh(pseudo_inertia(theta))[0] <= 0:
            raise InputError(f"the link behind joint '{name}' is no body that exists; write consistent parameters")
    remarks = (LUMPS, *remarks)
    if held:
        where = ", ".join(f"{name} at {position!r}" for name, position in held.items())
        remarks = (*remarks, f"Held while this was identified, and counted to the link before (rad or m): {where}.")
    friction = {"damping": damping, "coulomb": coulomb}
    if root.tag == "robot":
        if np.any(tree.armature):
            numbers = ", ".join(f"{name} {value!r}" for name, value in zip(names, _floats(tree.armature), strict=True))
            remarks = (*remarks, f"Armature, for which URDF has no place (kg m² or kg): {numbers}.")
        _into_urdf(root, tree, held, **friction)
    else:
        if held:
            raise InputError(
                f"{original}: joints of an MJCF file are held, whose bodies would have no mass; take them out of it"
            )
        _into_mjcf(original, root, model, tree, **friction)
    comment = ET.Comment("\n  " + "\n  ".join(line.replace("--", "- -") for line in remarks) + "\n")
    comment.tail = "\n"
    root.insert(0, comment)
    write_bytes(path, ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _into_urdf(root: ET.Element, tree: Tree, held: Collection[str], *, damping: Any, coulomb: Any) -> None:
    links = {link.get("name"): link for link in root.findall("link")}
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    fixed: dict[Any, list[Any]] = {}
    for joint in joints.values():
        if joint.get("type") not in MOVING or joint.get("name") in held:
            fixed.setdefault(_link(joint, "parent"), []).append(_link(joint, "child"))
    for k, name in enumerate(tree.names):
        joint = joints[name]
        child = _link(joint, "child")
        for rigid in _below(fixed, child):
            for inertial in links[rigid].findall("inertial"):
                links[rigid].remove(inertial)
        mass, centre, about = _about_centre(np.asarray(tree.inertias[k], float))
        inertial = ET.Element("inertial")
        ET.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(mass))
        places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
        ET.SubElement(inertial, "inertia", {key: repr(float(about[place])) for key, place in places.items()})
        links[child].insert(0, inertial)
        for key, values in (("damping", damping), ("friction", coulomb)):
            if values is not None:
                dynamics = joint.find("dynamics")
                dynamics = ET.SubElement(joint, "dynamics") if dynamics is None else dynamics
                dynamics.set(key, repr(_floats(values)[k]))


def _into_mjcf(original: Path, root: ET.Element, model: Any, tree: Tree, *, damping: Any, coulomb: Any) -> None:
    for element in root.iter():
        if element.tag in ("include", "replicate", "attach", "composite", "flexcomp", "model"):
            raise InputError(
                f"{original} has <{element.tag}>, with bodies that are elsewhere; expected one file, as MuJoCo saves it"
            )
    for compiler in root.findall("compiler"):
        # These settings would alter the inertias written below.
        for name in ("inertiafromgeom", "settotalmass", "boundmass", "boundinertia", "balanceinertia"):
            compiler.attrib.pop(name, None)
    k = 0
    for body, moves in _bodies(root):
        joints = list(_own(body, "joint"))
        if not (joints or moves):
            continue
        for inertial in body.findall("inertial"):
            body.remove(inertial)
        inertial = ET.Element("inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
        for joint in joints:
            theta = np.asarray(tree.inertias[k], float)
            if theta.any():
                # Move the parameters from the joint's anchor, the origin of the link's frame, to the body's frame.
                mass, centre, about = _about_centre(np.asarray(moved(theta, np.eye(3), model.jnt_pos[k])))
                entries = [about[place] for place in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
                inertial = ET.Element("inertial", pos=_text(centre), mass=repr(mass), fullinertia=_text(entries))
            named = (("armature", tree.armature), ("damping", damping), ("frictionloss", coulomb))
            for key, values in named:
                if values is not None:
                    joint.set(key, repr(_floats(values)[k]))
            k += 1
        body.insert(0, inertial)


def _bodies(root: ET.Element) -> Iterator[tuple[ET.Element, bool]]:
    """Bodies in MuJoCo's order, and whether a joint moves the parent of each."""

    def below(element: ET.Element, moves: bool) -> Iterator[tuple[ET.Element, bool]]:
        for child in element:
            if child.tag == "body":
                yield child, moves
                yield from below(child, moves or any(True for _ in _own(child, "joint")))
            elif child.tag == "frame":
                yield from below(child, moves)

    for world in root.findall("worldbody"):
        yield from below(world, False)


def _own(body: ET.Element, tag: str) -> Iterator[ET.Element]:
    """Child elements of a body, including those in its frames."""
    for child in body:
        if child.tag == tag:
            yield child
        elif child.tag == "frame":
            yield from _own(child, tag)


def _below(fixed: dict[Any, list[Any]], link: Any) -> list[Any]:
    """A link and all links fixed to it."""
    found = [link]
    for each in found:
        found.extend(fixed.get(each, ()))
    return found


def _link(joint: ET.Element, which: str) -> str | None:
    element = joint.find(which)
    return None if element is None else element.get("link")


def _about_centre(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass, and moments of inertia about it."""
    m, h, moments = parts(theta)
    centre = h / m
    return float(m), centre, moments - m * (centre @ centre * np.eye(3) - centre[:, None] * centre)


def _floats(values: Any) -> list[float]:
    return np.asarray(values, float).tolist()


def _text(numbers: Any) -> str:
    return " ".join(map(repr, _floats(numbers)))
