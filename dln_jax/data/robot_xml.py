"""Parses the XML of robot files; refuses other formats and files larger than any robot's."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np

from dln_jax.files import is_file
from dln_jax.types import InputError

LARGEST = 64 * 2**20
"""Largest file, bytes."""
MOST_JOINTS = 200
MOST_ELEMENTS = 20_000
DEEPEST = 3 * MOST_JOINTS
"""Deepest nesting of elements: per joint, MJCF nests a body and perhaps a frame."""
REPEATING = ("replicate", "composite", "flexcomp")
"""MJCF elements that stand for many."""


class _Elements(ET.TreeBuilder):
    """Builds elements, and refuses more than any robot has, since MuJoCo would compile such a file for minutes."""

    depth = count = 0

    def start(self, tag: Any, attrs: Any, /) -> ET.Element:
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > DEEPEST:
            raise InputError(f"its elements are nested more than {DEEPEST} deep; expected the file of a robot")
        if self.count > MOST_ELEMENTS:
            raise InputError(f"it has more than {MOST_ELEMENTS:,} elements; expected the file of one robot")
        if tag in REPEATING and _whole(attrs.get("count", "0")) > MOST_JOINTS:
            raise InputError(f"<{tag}> repeats {attrs['count']:.20} times; expected at most {MOST_JOINTS}")
        return super().start(tag, attrs)

    def end(self, tag: Any, /) -> ET.Element:
        self.depth -= 1
        return super().end(tag)


def _whole(text: str) -> float:
    """The largest number in an attribute; infinite if it is not numeric."""
    try:
        return max(map(float, text.split()), default=0.0)
    except ValueError:
        return np.inf


def parsed(path: Path) -> ET.Element:
    """The root element of a URDF or MJCF file, comments included; errors as `read_robot`."""
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
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a file that you may read") from None
    if b"<!ENTITY" in content.replace(b"\0", b""):  # in UTF-16 too
        raise InputError(f"{path}: it defines entities, which can grow without bound; expected plain XML")
    try:
        root = ET.fromstring(content, ET.XMLParser(target=_Elements(insert_comments=True)))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (ET.ParseError, LookupError, ValueError) as error:  # the last two for unknown encodings
        raise InputError(f"{path}: no XML ({error}); expected a URDF or MJCF file, in UTF-8") from None
    if root.tag not in ("robot", "mujoco"):
        raise InputError(f"{path}: its outer element is <{root.tag}>; expected <robot> (URDF) or <mujoco> (MJCF)")
    return root
