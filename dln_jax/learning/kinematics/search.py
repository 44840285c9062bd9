"""Searches joint frames by many descents from random starts, and by discrete moves of the best, in parallel threads.

Descents end in a few recurring local minima. If several starts agree on the lowest, it is probably the global minimum.

Two fitted trees are the same arm if their joint axes at q = 0 agree, up to gauges that torques cannot determine. A
rotation and a shift, with or without a mirror, align the two sets of axes. A point may slide along its axis, axes of
prismatic joints have only a direction, and gravity, if any, is one more direction.
"""

import functools
import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from dln_jax.learning.kinematics.frames import (
    Frames,
    KinematicPrior,
    mirror_image,
    random_frames,
    rough_frames,
    turn_round,
)
from dln_jax.learning.kinematics.projection import LENGTH, Descent, Program, Samples, Structure, descend
from dln_jax.types import JointVector, require_positive, require_seed

WAVE = 8
"""Starts between two tests of agreement; constant, so that results do not depend on the number of threads."""
ALIKE = 0.02
"""Largest relative difference of losses at the same local minimum."""
SAME_ANGLE, SAME_LENGTH = np.radians(5.0), 0.03
"""Largest angle and distance between axes of the same arm, rad and m."""
SAME_ERROR = 0.1
"""Largest relative difference of validation errors of agreeing descents."""
TURNS = 8
"""Initial angles of the alignment about an axis, for arms with parallel axes."""


class Search(NamedTuple):
    """Limits of the search; the first one reached ends it."""

    starts: int = 64
    """Largest number of random starts."""
    agreement: int = 5
    """Number of starts that must reach the lowest loss for the search to end."""
    iterations: int = 150
    """Largest number of iterations of a descent."""
    samples: int = 160
    """Samples drawn for the search; the best frames are refined on all samples."""
    seconds: float = float("inf")
    """Time limit of the search, s; at least one wave of starts runs."""
    confirm: bool = True
    """Search until two descents end at the same arm with the same validation error."""
    seed: int = 0
    threads: int = 2
    kinematic_prior: KinematicPrior | None = None
    """Frames near the starts, for example from a drawing with link lengths and rough axes (default: random starts)."""


def search(
    structure: Structure,
    program: Program,
    samples: Samples,
    unit: JointVector,
    settings: Search,
    *,
    until: float,
    before: tuple[list[Descent], int] = ([], 0),
) -> tuple[list[Descent], int]:
    """Descends from random starts, and from moves of the best, until enough descents agree on the lowest loss.

    Returns the final states of all descents, lowest loss first, and the number of random starts.

    Args:
        program: from `make_program`.
        until: reading of `time.perf_counter` at the end of the search.
        before: result of an earlier search to continue.

    Raises:
        InputError: a setting out of range.
    """
    counts = {name: getattr(settings, name) for name in ("starts", "agreement", "iterations", "seconds", "threads")}
    require_positive(**counts)
    if settings.kinematic_prior is not None:
        require_positive(angle=settings.kinematic_prior.angle, length=settings.kinematic_prior.length)
    require_seed(settings.seed)

    def end(frames: Frames) -> Descent:
        with jax.enable_x64(True):  # the setting is local to a thread
            limits = {"iterations": settings.iterations, "expired": lambda: time.perf_counter() > until}
            return descend(program, structure, frames, samples, unit, **limits)

    descents, done = before
    with ThreadPoolExecutor(settings.threads) as pool:
        starts = _starts(structure, settings, done)
        while wave := list(itertools.islice(starts, WAVE)):
            descents = _sorted([*descents, *pool.map(end, wave)])
            done += len(wave)
            if count_agreeing(descents) >= settings.agreement or time.perf_counter() > until:
                break
        for joints in (1, 2):
            while count_agreeing(descents) < settings.agreement and time.perf_counter() < until:
                best = descents[0]
                descents = _sorted([*descents, *pool.map(end, _turns(structure, best.frames, joints))])
                if not descents[0].at.loss < (1 - ALIKE) * best.at.loss:
                    break
    return descents, done


def count_agreeing(descents: list[Descent]) -> int:
    """Counts the descents that ended at the lowest loss."""
    return sum(float(descent.at.loss) <= (1 + ALIKE) * float(descents[0].at.loss) for descent in descents)


def _starts(structure: Structure, settings: Search, first: int) -> Iterator[Frames]:
    for index in range(first, settings.starts):
        random = np.random.default_rng([settings.seed, index])
        if settings.kinematic_prior is None:
            yield random_frames(len(structure.joints), random)
        else:
            yield rough_frames(settings.kinematic_prior, random)


def _turns(structure: Structure, frames: Frames, joints: int) -> Iterable[Frames]:
    """Yields the frames with every combination of this number of joints reversed."""
    for chosen in itertools.combinations(range(len(structure.joints)), joints):
        yield functools.reduce(lambda frames, joint: turn_round(frames, structure.parents, joint), chosen, frames)


def _sorted(descents: list[Descent]) -> list[Descent]:
    return sorted(descents, key=lambda descent: float(np.nan_to_num(descent.at.loss, nan=np.inf)))


class Difference(NamedTuple):
    """Largest differences between two arms."""

    angle: float
    """Between axes, or an axis and gravity, rad."""
    length: float
    """Between axes, across them, m."""

    @property
    def size(self) -> float:
        """Sum of angle and length, in units of their limits."""
        return self.angle / SAME_ANGLE + self.length / SAME_LENGTH

    @property
    def same(self) -> bool:
        """Whether both arms count as the same."""
        return bool(self.angle <= SAME_ANGLE and self.length <= SAME_LENGTH)


class Twin(NamedTuple):
    """Another descent to the lowest loss, refined in the same way."""

    error: float
    """Its validation error (or training error) relative to the fit."""
    off: Difference

    @property
    def same(self) -> bool:
        """Whether both are the same arm, with the same error."""
        return self.off.same and bool(abs(self.error - 1) <= SAME_ERROR)

    @property
    def words(self) -> str:
        """The comparison as text."""
        kind = "agree" if self.same else "differ"
        angle, length = np.degrees(self.off.angle), 1e3 * self.off.length
        return f"{kind}: axes within {angle:.2g}°, {length:.2g} mm, ratio of their errors {self.error:.3g}"


def difference(first: Frames, second: Frames, structure: Structure) -> Difference:
    """Compares two arms of the same structure."""
    gravity = structure.acceleration > 0
    one = lines_of(first, structure.parents, gravity=gravity)
    turning = np.array([kind == "revolute" for kind in structure.joints])
    others = second, mirror_image(second, structure.parents, structure.joints)
    offsets = [_aligned(one, lines_of(other, structure.parents, gravity=gravity), turning) for other in others]
    return min(offsets, key=lambda off: off.size)


def lines_of(frames: Frames, parents: Sequence[int], *, gravity: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns directions of the joint axes, then of gravity [d or d + 1, 3], and points on the axes [d, 3], at q =
    0."""
    d = len(parents)
    # The ground is last, at index -1.
    rotations, points = np.tile(np.eye(3), (d + 1, 1, 1)), np.zeros((d + 1, 3))
    for link, parent in enumerate(parents):
        rotations[link] = rotations[parent] @ frames.rotations[link]
        points[link] = points[parent] + rotations[parent] @ frames.positions[link]
    return np.append(rotations[:d, :, 2], -rotations[d:, :, 2] if gravity else np.zeros((0, 3)), axis=0), points[:d]


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
    # Angle between unit vectors from the length of the chord.
    angle = 2 * np.arcsin(np.minimum(np.linalg.norm(directions, axis=1).max() / 2, 1.0))
    return Difference(float(angle), float(np.linalg.norm(across, axis=1).max(initial=0.0)))
