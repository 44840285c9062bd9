"""Reads the XML of URDF and MJCF files: elements, the inertias of a URDF, and the limits of joints.

Other formats, and implausibly large files, are refused. So are malformed limits: MuJoCo ignores a range that is NaN,
empty, swapped or half stated, and a motion designed without it would drive the joint into its stop. The text of an MJCF
file is read only for ranges of two zeros, which look like no range after compilation.
"""

import os
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.files import is_file, is_folder
from dln_jax.mechanics.trees.inertia import inertial_parameters, moved
from dln_jax.types import InputError, require_once

LARGEST = 64 * 2**20
"""Largest file, bytes."""
MOST_JOINTS = 200
MOST_ELEMENTS, MOST_ATTRIBUTES = 20_000, 100
"""Most elements of a file, and attributes of an element."""
DEEPEST = 3 * MOST_JOINTS
"""Deepest nesting of elements: per joint, MJCF nests a body and perhaps a frame."""
REPEATING = ("replicate", "composite", "flexcomp")
"""MJCF elements that expand to many."""
MOVING = ("revolute", "continuous", "prismatic")
"""URDF joint types that move."""
SIDES = ("lower", "upper")
NUMBERS = {"limit": ("velocity", "effort", *SIDES), "dynamics": ("damping", "friction")}
"""Numeric attributes of the child elements of a URDF joint; only those of `SIDES` may be negative."""
MOMENTS = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
PLACEHOLDER = '<inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>'
"""Valid inertia for MuJoCo; the stated inertia of a link is read from the XML."""
REMEDY = "correct the file, or lock the joint"
RANGES = {"range": ("position", "limited"), "actuatorfrcrange": ("torque", "actuatorfrclimited")}
"""Attributes of an MJCF joint with two numbers -> the limited quantity, and the attribute that disables the limit."""


class _Elements(ET.TreeBuilder):
    """Builds elements, and refuses implausibly many, which MuJoCo would compile for minutes."""

    depth = count = 0

    def start(self, tag: Any, attrs: Any, /) -> ET.Element:
        tag = tag.rpartition("}")[2]  # some URDF files name a default namespace
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > DEEPEST:
            raise InputError(f"its elements are nested more than {DEEPEST} deep; expected the file of a robot")
        if self.count > MOST_ELEMENTS:
            raise InputError(f"it has more than {MOST_ELEMENTS:,} elements; expected the file of one robot")
        if len(attrs) > MOST_ATTRIBUTES:
            raise InputError(f"<{tag:.40}> has {len(attrs):,} attributes; expected the file of a robot")
        # A composite has up to three counts; words are refused, too.
        if tag in REPEATING and not all(_number(text) <= MOST_JOINTS for text in attrs.get("count", "0").split()):
            raise InputError(f"<{tag}> repeats {attrs['count']:.20} times; expected at most {MOST_JOINTS}")
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> ET.Element:
        self.depth -= 1
        return super().end(tag.rpartition("}")[2])


def parse_robot(path: Path) -> ET.Element:
    """Parses a URDF or MJCF file to its root element, with comments; errors as for `read_robot`."""
    root = _root(path)
    if root.tag not in ("robot", "mujoco"):
        raise InputError(f"{path}: its outer element is <{root.tag}>; expected <robot> (URDF) or <mujoco> (MJCF)")
    for part in _with_included(path, root):
        _require_readable(path, part)
    # In Drake and Bullet, a file need not define the link "world"; in MuJoCo it must.
    parents = {parent.get("link") for joint in root.findall("joint") for parent in joint.findall("parent")}
    if "world" in parents and all(link.get("name") != "world" for link in root.findall("link")):
        root.append(ET.Element("link", name="world"))
    return root


def _root(path: Path) -> ET.Element:
    """Parses a file to its outer element; `InputError` for unreadable files."""
    if not is_file(path):
        raise InputError(f"{path}: no such file; give the URDF or MJCF file of a robot")
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(
                f"{path} has {size >> 20} MiB; expected a URDF or MJCF file of at most {LARGEST >> 20} MiB"
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if b"<!ENTITY" in content.replace(b"\0", b""):  # in UTF-16 too
        raise InputError(f"{path}: it defines entities, which can grow without bound; expected plain XML")
    try:
        return ET.fromstring(content, ET.XMLParser(target=_Elements(insert_comments=True)))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (ET.ParseError, LookupError, ValueError) as error:  # the last two for unknown encodings
        raise InputError(f"{path}: not XML ({error}); expected a URDF or MJCF file, in UTF-8") from None


def link_inertias(root: ET.Element) -> dict[str, np.ndarray]:
    """Returns the inertial parameters [10] of URDF links by name, as stated, even if not physically consistent.

    Raises:
        InputError: an <inertial> is incomplete, not numeric or has a negative mass.
    """
    from scipy.spatial.transform import Rotation

    parameters = {}
    for link in root.findall("link"):
        inertial, name = link.find("inertial"), link.get("name", "")
        if inertial is None:
            continue
        origin, mass, inertia = (_attributes(inertial, tag) for tag in ("origin", "mass", "inertia"))
        m = _number(mass.get("value", ""))
        moments = np.array([[_number(inertia.get(key, "")) for key in row] for row in MOMENTS])
        xyz, rpy = ([_number(text) for text in origin.get(key, "0 0 0").split()] for key in ("xyz", "rpy"))
        if not (len(xyz) == len(rpy) == 3 and m >= 0 and np.isfinite([m, *moments.ravel(), *xyz, *rpy]).all()):
            raise InputError(
                f"link '{name}' has an incomplete <inertial>; expected a mass of zero or more and six moments, all "
                "finite numbers"
            )
        turn = Rotation.from_euler("xyz", rpy).as_matrix()  # about the fixed axes x, y, z, in this order
        theta = inertial_parameters(m, np.zeros(3), moments)
        parameters[name] = np.asarray(moved(theta, turn, np.array(xyz)))
    return parameters


def without_shapes(root: ET.Element, *, inertias: bool) -> ET.Element:
    """Prepares a URDF for MuJoCo: removes shapes, keeps every link as a body, and sets its or placeholder inertias."""
    for link in root.iter("link"):
        remove(link, "visual", "collision")
        if inertias:
            continue
        remove(link, "inertial")
        link.append(ET.fromstring(PLACEHOLDER))
    settings = root.find("mujoco")
    settings = ET.SubElement(root, "mujoco") if settings is None else settings
    remove(settings, "compiler")
    ET.SubElement(settings, "compiler", fusestatic="false", balanceinertia="false")
    return root


def remove(element: ET.Element, *tags: str) -> None:
    """Removes the children with these tags."""
    for part in [part for part in element if part.tag in tags]:
        element.remove(part)


def check_joints(path: Path, root: ET.Element, locked: Collection[str]) -> None:
    """Raises `InputError` for joints that MuJoCo would misread; locked joints are not checked.

    Limits must be two finite numbers, lower < upper. In a URDF, velocities and efforts must not be negative, names must
    differ, joints must be of a known type, and at most `MOST_JOINTS` may move.
    """
    if root.tag == "mujoco":
        for joint in (joint for part in _with_included(path, root) for joint in part.iter("joint")):
            for attribute, (kind, switch) in RANGES.items():
                stated = joint.get(attribute, "").split()
                zero = stated and not any(map(_number, stated))
                if zero and joint.get(switch) != "false" and joint.get("name") not in locked:
                    require_range(f"joint '{joint.get('name') or 'of a default class'}'", kind, stated)
        return
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    require_once("the list of joints", [joint.get("name", "") for joint in root.findall("joint")])
    moving = {name: joint for name, joint in joints.items() if joint.get("type") != "fixed" and name not in locked}
    if len(moving) > MOST_JOINTS:
        raise InputError(f"it has {len(moving)} joints that move; expected 1 to {MOST_JOINTS}")
    for name, joint in moving.items():
        kind = joint.get("type")
        if kind not in MOVING:
            raise InputError(
                f"joint '{name}' is of type '{kind}'; expected {', '.join(MOVING)} or fixed: lock it if it is still"
            )
        sides = [_attributes(joint, "limit").get(side, "") for side in SIDES]
        if kind != "continuous" and any(sides):
            require_range(f"joint '{name}'", "position", sides)
        for tag, keys in NUMBERS.items():
            for key in keys:
                text = _attributes(joint, tag).get(key, "0")
                if not _number(text) >= (-np.inf if key in SIDES else 0.0):
                    wanted = "a number" if key in SIDES else "zero or more"
                    raise InputError(
                        f"joint '{name}': the {key} in <{tag}> is '{text:.40}'; expected {wanted}: {REMEDY}"
                    )


def velocity_limits(root: ET.Element) -> dict[str, float]:
    """Returns the velocity limits of a URDF by joint, rad/s or m/s, from <limit velocity="...">.

    Joints without a limit are left out, and so are limits of 0, which mean an unknown limit in some files.
    """
    stated = {
        joint.get("name", ""): _attributes(joint, "limit").get("velocity", "0") for joint in root.findall("joint")
    }
    return {name: _number(text) for name, text in stated.items() if _number(text) > 0}


def driven_joints(root: ET.Element) -> list[str]:
    """Returns the names of the URDF joints that a <transmission> connects to a motor."""
    return [joint.get("name", "") for motor in root.findall("transmission") for joint in motor.findall("joint")]


def require_range(name: str, kind: str, stated: Sequence[str]) -> None:
    """Raises `InputError` unless the limits of a joint or actuator are two finite numbers, the lower first."""
    numbers = np.array([_number(text) for text in stated])
    if not (numbers.shape == (2,) and np.isfinite(numbers).all() and numbers[0] < numbers[1]):
        shown = ", ".join(f"{text:.40}" if text else "nothing" for text in stated)
        raise InputError(f"{name} has limits of {kind} {shown}; expected two finite numbers, the lower first: {REMEDY}")


def _number(text: str) -> float:
    """Converts text to a number; NaN for other text."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _attributes(element: ET.Element, tag: str) -> dict[str, str]:
    """Returns the attributes of the first child with this tag; empty without one."""
    return next((part.attrib for part in element.findall(tag)), {})


def _with_included(path: Path, root: ET.Element, seen: Collection[Path] = ()) -> Iterator[ET.Element]:
    """Yields the outer elements of an MJCF file and of included or attached files; MuJoCo reports missing ones."""
    yield root
    seen = {*seen, path.resolve()}
    for part in (*root.iter("include"), *root.iter("model")):
        file = path.parent / part.get("file", "")
        if is_file(file) and file.resolve() not in seen:
            yield from _with_included(file, _root(file), seen)


def _require_readable(path: Path, root: ET.Element) -> None:
    """Raises `InputError` for names of pipes or devices, on which MuJoCo would wait forever."""
    if root.tag == "robot":
        return
    compilers = list(root.iter("compiler"))
    folders = {part.get(key, "") for part in compilers for key in ("meshdir", "texturedir", "assetdir")}
    for part in root.iter():
        for folder in {"", *folders}:
            file = path.parent / folder / part.get("file", "")
            if os.path.exists(file) and not (is_file(file) or is_folder(file)):
                raise InputError(f"{path}: <{part.tag}> names {file}, which is not a regular file; give a regular file")
