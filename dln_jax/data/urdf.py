"""Reads inertias from a URDF file in the frames of its links, physically consistent or not."""

import xml.etree.ElementTree as ET
from collections.abc import Collection

import numpy as np

from dln_jax.mechanics.trees.inertia import inertial_parameters, moved
from dln_jax.types import InputError

MOVING = ("revolute", "continuous", "prismatic")
"""Joint types that move."""
NUMBERS = {"limit": ("lower", "upper", "effort", "velocity"), "dynamics": ("damping", "friction")}
"""Numeric attributes of a joint's child elements."""
MOMENTS = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))


def link_inertias(root: ET.Element) -> dict[str, np.ndarray]:
    """Inertial parameters [10] of every link that states them, by name.

    Raises:
        InputError: an <inertial> is incomplete, not numeric or has a negative mass.
    """
    found = {}
    for link in root.findall("link"):
        inertial = link.find("inertial")
        if inertial is not None:
            name = link.get("name", "")
            try:
                found[name] = _parameters(inertial)
            except (AttributeError, TypeError, ValueError):
                raise InputError(
                    f"link '{name}' has an <inertial> that is incomplete; expected a mass, not below zero, and six "
                    "moments, all finite numbers"
                ) from None
    return found


def require_joints(root: ET.Element, held: Collection[str], most: int) -> None:
    """Raises `InputError` for joints that MuJoCo would misread, or for more than `most` moving joints."""
    moving = [joint for joint in root.findall("joint") if joint.get("name", "") not in held]
    moving = [joint for joint in moving if joint.get("type") != "fixed"]
    if len(moving) > most:
        raise InputError(f"it has {len(moving)} joints that move; expected 1 to {most}")
    names = [joint.get("name", "") for joint in root.findall("joint")]
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise InputError(f"two joints are named '{twice[0]:.60}'; give each a name of its own")
    for joint in moving:
        if joint.get("type") not in MOVING:
            raise InputError(
                f"joint '{joint.get('name')}' is of type '{joint.get('type')}'; expected {', '.join(MOVING)} or fixed: "
                "lock it, if so"
            )
        for tag, keys in NUMBERS.items():
            element = joint.find(tag)
            for key in keys:
                text = "0" if element is None else element.get(key, "0")
                try:
                    float(text)
                except ValueError:
                    raise InputError(
                        f"joint '{joint.get('name')}': the {key} in <{tag}> is '{text:.40}'; expected a number"
                    ) from None


def without_inertias(root: ET.Element) -> ET.Element:
    """Prepares the file for MuJoCo: no shapes, every link a body of its own, and unit inertias that MuJoCo accepts."""
    for link in root.iter("link"):
        for part in [*link.findall("visual"), *link.findall("collision"), *link.findall("inertial")]:
            link.remove(part)
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value="1")
        ET.SubElement(inertial, "inertia", ixx="1", ixy="0", ixz="0", iyy="1", iyz="0", izz="1")
    for settings in root.findall("mujoco"):
        root.remove(settings)
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", fusestatic="false", balanceinertia="false")
    return root


def _parameters(inertial: ET.Element) -> np.ndarray:
    origin, mass, inertia = (inertial.find(tag) for tag in ("origin", "mass", "inertia"))
    m = float(mass.get("value"))  # type: ignore[union-attr, arg-type]
    moments = np.array([[float(inertia.get(key)) for key in row] for row in MOMENTS])  # type: ignore[union-attr, arg-type]
    xyz, rpy = (_vector(origin, key) for key in ("xyz", "rpy"))
    if not (m >= 0 and np.isfinite([m, *moments.ravel(), *xyz, *rpy]).all()):
        raise ValueError
    return np.asarray(moved(inertial_parameters(m, np.zeros(3), moments), _turned(rpy), xyz))


def _vector(origin: ET.Element | None, key: str) -> np.ndarray:
    found = np.array((origin.get(key, "0 0 0") if origin is not None else "0 0 0").split(), float)
    if found.shape != (3,):
        raise ValueError
    return found


def _turned(rpy: np.ndarray) -> np.ndarray:
    """Rotation matrix of roll, pitch and yaw about the fixed axes x, y, z, in this order."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x
