"""Compares two fitted trees: are their joint axes at q = 0 the same, up to what torques cannot determine?

The axes of one arm are moved onto those of the other by a rotation and a shift, with or without a mirror. A point may
slide along its axis, axes of prismatic joints have directions only, and gravity, if any, is one more direction.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dln_jax.learning.kinematics.frames import Frames, mirror_image
from dln_jax.learning.kinematics.projection import LENGTH, Structure

SAME_ANGLE, SAME_LENGTH = np.radians(5.0), 0.03
"""Largest angle and distance between the axes of two arms that count as the same, rad and m."""
SAME_ERROR = 0.1
"""Largest relative difference of the validation errors of two descents that agree."""
TURNS = 8
"""Initial angles of the comparison about an axis, for arms whose axes are parallel."""


class Difference(NamedTuple):
    """Largest differences between two arms."""

    angle: float
    """Between axes, or an axis and gravity, rad."""
    length: float
    """Between axes, across them, m."""

    @property
    def size(self) -> float:
        """Sum of both, in units of the limits."""
        return self.angle / SAME_ANGLE + self.length / SAME_LENGTH

    @property
    def same(self) -> bool:
        """Whether they count as one arm."""
        return bool(self.angle <= SAME_ANGLE and self.length <= SAME_LENGTH)


class Twin(NamedTuple):
    """Another descent to the lowest loss, refined in the same way."""

    error: float
    """Its validation error (without validation, training error) relative to that of the fit."""
    off: Difference

    @property
    def same(self) -> bool:
        """Whether both are the same arm, with the same error."""
        return self.off.same and bool(abs(self.error - 1) <= SAME_ERROR)

    @property
    def words(self) -> str:
        """The comparison as text."""
        kind = "the same arm" if self.same else "another arm"
        angle, length = np.degrees(self.off.angle), 1e3 * self.off.length
        return f"{kind} (axes within {angle:.2g}° and {length:.2g} mm, error {self.error:.3g} times)"


def difference(first: Frames, second: Frames, structure: Structure) -> Difference:
    """Compares two arms of the same structure."""
    gravity = structure.acceleration > 0
    one = lines_of(first, structure.parents, gravity=gravity)
    turning = np.array([kind == "revolute" for kind in structure.joints])
    others = second, mirror_image(second, structure.parents, structure.joints)
    offsets = [_aligned(one, lines_of(other, structure.parents, gravity=gravity), turning) for other in others]
    return min(offsets, key=lambda off: off.size)


def lines_of(frames: Frames, parents: Sequence[int], *, gravity: bool) -> tuple[np.ndarray, np.ndarray]:
    """Directions of the joint axes [d, 3], followed by that of gravity, and points on the axes [d, 3], at q = 0."""
    rotations: list[np.ndarray] = []
    points: list[np.ndarray] = []
    for link, parent in enumerate(parents):
        R, p = (np.eye(3), np.zeros(3)) if parent < 0 else (rotations[parent], points[parent])
        rotations.append(R @ np.asarray(frames.rotations[link]))
        points.append(p + R @ np.asarray(frames.positions[link]))
    down = [np.array([0.0, 0.0, -1.0])] * gravity
    return np.stack([*(R[:, 2] for R in rotations), *down]), np.stack(points)


def _aligned(
    one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray], turning: np.ndarray
) -> Difference:
    (ours, points), (theirs, _) = one, other
    axes = ours[: len(points)]
    centres = [p - p[turning].mean(axis=0) if turning.any() else p for _, p in (one, other)]

    def errors(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R = Rotation.from_rotvec(x[:3]).as_matrix()
        apart = centres[1] @ R.T + x[3:] - centres[0]
        across = apart - np.sum(apart * axes, axis=1, keepdims=True) * axes
        return theirs @ R.T - ours, across[turning]

    def residual(x: np.ndarray) -> np.ndarray:
        directions, across = errors(x)
        return np.concatenate([LENGTH * directions.ravel(), across.ravel()])

    first = Rotation.align_vectors(ours, theirs)[0]
    starts = [Rotation.from_rotvec(2 * np.pi * k / TURNS * axes[-1]) * first for k in range(TURNS)]
    solutions = [least_squares(residual, np.append(start.as_rotvec(), np.zeros(3))) for start in starts]
    directions, across = errors(min(solutions, key=lambda solution: solution.cost).x)
    # Angle between unit vectors from the length of the chord between them.
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(directions, axis=1).max() / 2, 1.0))
    return Difference(float(angle), float(np.linalg.norm(across, axis=1).max(initial=0.0)))
