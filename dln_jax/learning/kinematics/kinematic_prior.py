"""Kinematic prior of an arm: a rough description near which the search for its frames starts.

It holds the joint axes in space at q = 0, with z up, and a point on every axis; or Denavit-Hartenberg rows.
"""

import reprlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.learning.kinematics.frames import Frames
from dln_jax.mechanics.trees.description import dh_frames
from dln_jax.types import InputError, finite_array

FIELDS = {"axes": 3, "points": 3, "dh_rows": 4}
"""Number of columns of the fields."""
ROUGHNESS = {"angle_degrees": 30.0, "length": 0.05}
EXPECTED = (
    'expected {"axes": [[x, y, z], ...], "points": [[x, y, z], ...]} or {"dh_rows": [[alpha, a, d, theta], ...]}, a '
    'row for each joint, and if known "angle_degrees" and "length" by which they are off'
)


class KinematicPrior(NamedTuple):
    """Frames and their deviations."""

    frames: Frames
    angle: float = float(np.radians(ROUGHNESS["angle_degrees"]))
    """Deviation of the axes, rad."""
    length: float = ROUGHNESS["length"]
    """Deviation of the positions, m."""


def frames_of_axes(
    axes: Float[np.ndarray, "d 3"], points: Float[np.ndarray, "d 3"], parents: Sequence[int] | None = None
) -> Frames:
    """Returns frames with z along the joints' axes and the origin at their points, relative to the parent link.

    Args:
        axes: of the joints in space at q = 0, of any length.
        points: on the axes, m.
        parents: parent link of every link, -1 for the ground; a serial chain by default.

    Raises:
        InputError: arrays of another shape or not finite, or an axis of length zero.
    """
    d = len(points)
    axes, points = finite_array("axes", axes, (d, 3)), finite_array("points", points, (d, 3))
    lengths = np.linalg.norm(axes, axis=1)
    if not (lengths > 0).all():
        raise InputError(f"joint {int(np.argmin(lengths)) + 1} has an axis of length zero; expected a direction")
    order = tuple(range(-1, d - 1)) if parents is None else tuple(parents)
    turned = [_with_z_along(axis) for axis in axes / lengths[:, None]]
    rotations, positions = [], []
    for link, parent in enumerate(order):
        R, p = (np.eye(3), np.zeros(3)) if parent < 0 else (turned[parent], points[parent])
        rotations.append(R.T @ turned[link])
        positions.append(R.T @ (points[link] - p))
    return Frames(np.array(rotations), np.array(positions))


def kinematic_prior_from_json(values: Any, d: int, parents: Sequence[int] | None = None) -> KinematicPrior:
    """Builds the prior of d joints from JSON values.

    Raises:
        InputError: unknown fields, another number of rows, or arrays that `frames_of_axes` refuses.
    """
    names = set(values) - set(ROUGHNESS) if isinstance(values, dict) else set()
    if names not in ({"axes", "points"}, {"dh_rows"}):
        raise InputError(f"{EXPECTED}; got {reprlib.repr(values)}")
    rows = {name: _rows(name, values[name], d) for name in names}
    rough = {name: _positive(name, values.get(name, default)) for name, default in ROUGHNESS.items()}
    if "dh_rows" in rows:
        if parents is not None and tuple(parents) != tuple(range(-1, d - 1)):
            raise InputError("dh_rows describe joints one after the other; give axes and points where links branch")
        frames = Frames(*dh_frames(rows["dh_rows"]))
    else:
        frames = frames_of_axes(rows["axes"], rows["points"], parents)
    return KinematicPrior(frames, float(np.radians(rough["angle_degrees"])), rough["length"])


def _rows(name: str, given: Any, d: int) -> np.ndarray:
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError):
        found = np.zeros(0)
    if found.shape != (d, FIELDS[name]) or not np.isfinite(found).all():
        raise InputError(f"{name}: expected {d} rows of {FIELDS[name]} finite numbers, one for each joint")
    return found


def _positive(name: str, given: Any) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < given < np.inf:
        raise InputError(f"{name} is {reprlib.repr(given)}; expected a positive number")
    return float(given)


def _with_z_along(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Returns a rotation whose last column is the unit vector `axis`."""
    x = np.cross(np.eye(3)[np.argmin(abs(axis))], axis)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
