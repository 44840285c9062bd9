"""Joint frames as points to search among: random ones, steps between them, and moves to other valleys."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.models.serial_tree import rotation
from dln_jax.types import JointKind

REACH = 0.15
"""m, standard deviation of each coordinate of a random joint's place."""


class Frames(NamedTuple):
    """Of the links of a tree at q = 0, each in that of the link that it hangs on; joints are about z."""

    rotations: Any
    """[d, 3, 3]."""
    positions: Any
    """[d, 3], m."""


def random_frames(d: int, random: np.random.Generator) -> Frames:
    """Frames turned in any way."""
    rotations, _ = np.linalg.qr(random.normal(size=(d, 3, 3)))
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    return Frames(rotations, REACH * random.normal(size=(d, 3)))


def rough_frames(sketch: Frames, random: np.random.Generator, *, angle: float, length: float) -> Frames:
    """Frames some way from a sketch: turned by `angle`, rad, about a random axis, and moved by `length`, m."""
    directions = random.normal(size=(2, *np.shape(sketch.positions)))
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    turns = np.asarray(jax.vmap(rotation)(jnp.asarray(angle * directions[0])))
    return Frames(np.asarray(sketch.rotations) @ turns, np.asarray(sketch.positions) + length * directions[1])


def free_directions(parents: Sequence[int], joints: Sequence[JointKind]) -> np.ndarray:
    """Places in a flat step [d, 6] of the numbers that torques may show; the others are gauges.

    A link's frame may turn about and slide along its own z, so that four numbers are left: two tilts of the axis, and
    two shifts across it. A prismatic joint's axis, and the base's, have a direction and no place.
    """
    places = []
    for link, (parent, kind) in enumerate(zip(parents, joints, strict=True)):
        shifts = (3, 4) if kind == "revolute" and parent >= 0 else ()
        places += [6 * link + k for k in (0, 1, *shifts)]
    return np.array(places)


def displaced(frames: Frames, step: Float[Array, "d 6"]) -> Frames:
    """Frames turned by rotation vectors step[:, :3], rad, and moved by step[:, 3:], m, both in their own axes."""
    positions = frames.positions + jnp.einsum("iab,ib->ia", frames.rotations, step[:, 3:])
    return Frames(frames.rotations @ jax.vmap(rotation)(step[:, :3]), positions)


def turned_round(frames: Frames, parents: Sequence[int], joint: int) -> Frames:
    """The same arm at q = 0 with one joint that turns, or slides, the other way.

    Where gravity rules, it hardly tells these two apart, and descents end in either.
    """
    half = np.diag([1.0, -1.0, -1.0])
    rotations, positions = (np.array(each) for each in frames)
    rotations[joint] = rotations[joint] @ half
    for link, parent in enumerate(parents):
        if parent == joint:
            rotations[link], positions[link] = half @ rotations[link], half @ positions[link]
    return Frames(rotations, positions)


def mirrored(frames: Frames, parents: Sequence[int], joints: Sequence[JointKind]) -> Frames:
    """The mirror image, which the same motions take through the same torques if the inertias are mirrored too.

    Reflecting x, also of every link's frame, reverses how joints turn; y and z of the links that turn are reversed to
    undo it.
    """
    mirror, half = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0])
    own = [half if kind == "revolute" else np.eye(3) for kind in joints]
    before = [np.eye(3) if parent < 0 else own[parent] for parent in parents]
    rotations = [
        turn @ mirror @ R @ mirror @ after for turn, R, after in zip(before, frames.rotations, own, strict=True)
    ]
    positions = [turn @ mirror @ p for turn, p in zip(before, frames.positions, strict=True)]
    return Frames(np.array(rotations), np.array(positions))
