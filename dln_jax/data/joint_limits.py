"""Reads joint limits of URDF and MJCF files and refuses malformed ones.

MuJoCo treats a range that is NaN, empty, swapped or half stated as no range. A motion designed from such a file would
drive the joint into its stop, so the file is refused before MuJoCo reads it.
"""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from dln_jax.types import InputError

REMEDY = "correct the file, or lock the joint"
LIMITED = {"range": "limited", "actuatorfrcrange": "actuatorfrclimited"}
"""Attributes of an MJCF joint that hold two numbers, and the attributes that disable them."""
KINDS = {"range": "position", "actuatorfrcrange": "torque"}


def check_limits(path: Path, root: ET.Element, held: Collection[str]) -> None:
    """Raises `InputError` that names the first joint whose limits are not two finite numbers, lower < upper, or whose
    velocity or effort in a URDF is negative or not a number. Locked joints (`held`) are not checked."""
    if root.tag == "robot":
        for joint in root.findall("joint"):
            if joint.get("name") not in held and joint.get("type") in ("revolute", "prismatic", "continuous"):
                _check_urdf(joint)
        return
    for joint in (each for part in _with_included(path, root) for each in part.iter("joint")):
        for attribute in LIMITED if joint.get("name") not in held else ():
            stated = joint.get(attribute)
            if stated is not None and joint.get(LIMITED[attribute]) != "false":
                _require_range(joint.get("name") or "of a default class", KINDS[attribute], stated.split())


def velocity_limits(root: ET.Element, names: Sequence[str]) -> np.ndarray:
    """Velocity limits from <limit velocity="...">, rad/s or m/s; infinite if missing or 0 (unknown, in some files)."""
    stated = {}
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        stated[joint.get("name")] = "0" if limit is None else limit.get("velocity", "0")
    numbers = [_number(stated.get(name, "0")) for name in names]
    return np.array([each if each > 0 else np.inf for each in numbers])


def _check_urdf(joint: ET.Element) -> None:
    limit, name = joint.find("limit"), joint.get("name", "")
    if limit is None:
        return
    sides = [limit.get(side, "") for side in ("lower", "upper")]
    if joint.get("type") != "continuous" and any(sides):
        _require_range(name, "position", sides)
    for kind in ("velocity", "effort"):
        if not _number(limit.get(kind, "0")) >= 0:
            raise InputError(
                f"joint '{name}' has a limit of {kind} of '{limit.get(kind):.40}'; expected a number that is not "
                f"negative: {REMEDY}"
            )


def _require_range(name: str, kind: str, stated: Sequence[str]) -> None:
    numbers = np.array([_number(each) for each in stated])
    if not (numbers.shape == (2,) and np.isfinite(numbers).all() and numbers[0] < numbers[1]):
        shown = ", ".join(f"{each:.40}" if each else "nothing" for each in stated)
        raise InputError(
            f"joint '{name}' has limits of {kind} {shown}; expected two finite numbers, the lower first: {REMEDY}"
        )


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _with_included(path: Path, root: ET.Element) -> Iterator[ET.Element]:
    """The root element and those of included files; unreadable ones are skipped, since MuJoCo reports them."""
    yield root
    for include in root.iter("include"):
        file = path.parent / include.get("file", "")
        if file.is_file() and file.resolve() != path.resolve():
            try:
                yield ET.parse(file).getroot()
            except ET.ParseError:
                continue
