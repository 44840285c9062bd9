"""Joint frames as unknowns of a search: random frames, steps, and moves to other local minima.

A kinematic prior is a rough description of the arm; the search starts near it. It has the joint axes in space at q = 0,
with z up, and a point on each axis, or Denavit-Hartenberg rows.
"""

import reprlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.mechanics.trees.description import dh_frames
from dln_jax.models.trees import rotation
from dln_jax.types import InputError, JointKind, finite_array

FIELDS = {"axes": 3, "points": 3, "dh_rows": 4}
"""Number of columns of the fields."""
ROUGHNESS = {"angle_degrees": 30.0, "length": 0.05}
EXPECTED = (
    'expected {"axes": [[x, y, z], ...], "points": [[x, y, z], ...]} or {"dh_rows": [[alpha, a, d, theta], ...]}, a '
    'row per joint, and optionally their errors, "angle_degrees" and "length"'
)
REACH = 0.15
"""Standard deviation of each coordinate of a random joint position, m."""


class Frames(NamedTuple):
    """Link frames of a tree at q = 0, relative to the parent link; joint axes are z."""

    rotations: Any
    """[d, 3, 3]."""
    positions: Any
    """[d, 3], m."""


class KinematicPrior(NamedTuple):
    """Prior frames and their standard deviations."""

    frames: Frames
    angle: float = float(np.radians(ROUGHNESS["angle_degrees"]))
    """Deviation of the axes, rad."""
    length: float = ROUGHNESS["length"]
    """Deviation of the positions, m."""


def random_frames(d: int, random: np.random.Generator) -> Frames:
    """Returns frames with random orientations and positions."""
    rotations, _ = np.linalg.qr(random.normal(size=(d, 3, 3)))
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    return Frames(rotations, REACH * random.normal(size=(d, 3)))


def rough_frames(prior: KinematicPrior, random: np.random.Generator) -> Frames:
    """Perturbs prior frames by their deviations: rotates them about random axes and moves them."""
    rotations, positions = map(np.asarray, prior.frames)
    directions = random.normal(size=(2, *positions.shape))
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    turns = np.asarray(jax.vmap(rotation)(jnp.asarray(prior.angle * directions[0])))
    return Frames(rotations @ turns, positions + prior.length * directions[1])


def free_directions(parents: Sequence[int], joints: Sequence[JointKind]) -> np.ndarray:
    """Returns the indices into a flat step [d, 6] of the coordinates that torques can identify; the rest are gauges.

    A link's frame may rotate about its own z and slide along it, which leaves two tilts of the axis and two shifts
    across it. The axis of a prismatic joint, or of a joint on the base, has a direction but no position.
    """
    places = []
    for link, (parent, kind) in enumerate(zip(parents, joints, strict=True)):
        shifts = (3, 4) if kind == "revolute" and parent >= 0 else ()
        places += [6 * link + k for k in (0, 1, *shifts)]
    return np.array(places)


def displace(frames: Frames, step: Float[Array, "d 6"]) -> Frames:
    """Rotates frames by the vectors step[:, :3], rad, and moves them by step[:, 3:], m, both in their own axes."""
    positions = frames.positions + jnp.einsum("iab,ib->ia", frames.rotations, step[:, 3:])
    return Frames(frames.rotations @ jax.vmap(rotation)(step[:, :3]), positions)


def turn_round(frames: Frames, parents: Sequence[int], joint: int) -> Frames:
    """Returns the same arm at q = 0 with one joint's direction of motion reversed.

    Where gravity dominates, torques hardly distinguish the two arms, and descents end at either.
    """
    half, carried = np.diag([1.0, -1.0, -1.0]), np.equal(parents, joint)
    rotations, positions = map(np.array, frames)
    rotations[joint] = rotations[joint] @ half
    rotations[carried] = half @ rotations[carried]
    positions[carried] = positions[carried] @ half
    return Frames(rotations, positions)


def mirror_image(frames: Frames, parents: Sequence[int], joints: Sequence[JointKind]) -> Frames:
    """Returns the mirror image, which moves in the same way under the same torques if the inertias are mirrored too.

    Reflecting x in every frame reverses the rotation of revolute joints; reversing y and z of their links restores it.
    """
    mirror, half = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0])
    # The ground is last, at index -1.
    own = np.array([*(half if kind == "revolute" else np.eye(3) for kind in joints), np.eye(3)])
    turned = own[list(parents)] @ mirror
    positions = np.einsum("iab,ib->ia", turned, np.asarray(frames.positions))
    return Frames(turned @ np.asarray(frames.rotations) @ mirror @ own[:-1], positions)


def frames_of_axes(
    axes: Float[np.ndarray, "d 3"], points: Float[np.ndarray, "d 3"], parents: Sequence[int] | None = None
) -> Frames:
    """Returns frames with z along the joints' axes and the origin at their points, relative to the parent link.

    Args:
        axes: directions of the joints in space at q = 0, of any length.
        points: one point on each axis, m.
        parents: parent link of every link, -1 for the ground (default: a serial chain).

    Raises:
        InputError: arrays with a wrong shape or values that are not finite, or an axis of length zero.
    """
    d = len(points)
    axes, points = finite_array("axes", axes, (d, 3)), finite_array("points", points, (d, 3))
    lengths = np.linalg.norm(axes, axis=1)
    if not (lengths > 0).all():
        raise InputError(f"joint {int(np.argmin(lengths)) + 1} has an axis of length zero; expected a direction")
    order = list(range(-1, d - 1) if parents is None else parents)
    # The ground is last, at index -1.
    turned = np.array([*map(_with_z_along, axes / lengths[:, None]), np.eye(3)])
    into = turned[order].transpose(0, 2, 1)
    apart = points - np.append(points, np.zeros((1, 3)), axis=0)[order]
    return Frames(into @ turned[:-1], np.einsum("iab,ib->ia", into, apart))


def kinematic_prior_from_json(values: Any, d: int, parents: Sequence[int] | None = None) -> KinematicPrior:
    """Builds the prior of d joints from JSON values.

    Raises:
        InputError: unknown fields, a wrong number of rows, or arrays that `frames_of_axes` refuses.
    """
    names = set(values) - set(ROUGHNESS) if isinstance(values, dict) else set()
    if names not in ({"axes", "points"}, {"dh_rows"}):
        raise InputError(f"{EXPECTED}; got {reprlib.repr(values)}")
    rows = {name: _rows(name, values[name], d) for name in names}
    rough = {name: _positive(name, values.get(name, default)) for name, default in ROUGHNESS.items()}
    if "dh_rows" in rows:
        if parents is not None and tuple(parents) != tuple(range(-1, d - 1)):
            raise InputError("dh_rows describe serial chains only; give axes and points for trees with branches")
        frames = Frames(*dh_frames(rows["dh_rows"]))
    else:
        frames = frames_of_axes(rows["axes"], rows["points"], parents)
    return KinematicPrior(frames, float(np.radians(rough["angle_degrees"])), rough["length"])


def _rows(name: str, value: Any, d: int) -> np.ndarray:
    try:
        return finite_array(name, value, (d, FIELDS[name]))
    except InputError:
        raise InputError(f"{name}: expected {d} rows of {FIELDS[name]} finite numbers, one per joint") from None


def _positive(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise InputError(f"{name} is {reprlib.repr(value)}; expected a positive number")
    return float(value)


def _with_z_along(axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Returns a rotation with the unit vector `axis` as its last column."""
    x = np.cross(np.eye(3)[np.argmin(abs(axis))], axis)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)
