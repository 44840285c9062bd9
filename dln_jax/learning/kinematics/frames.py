"""Joint frames as the unknowns of a search: random ones, steps between them, and moves to other local minima."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.models.serial_tree import rotation
from dln_jax.types import JointKind

REACH = 0.15
"""Standard deviation in m of the coordinates of a random joint's position."""


class Frames(NamedTuple):
    """Link frames of a tree at q = 0, relative to the parent link; joint axes are z."""

    rotations: Any
    """[d, 3, 3]."""
    positions: Any
    """[d, 3], m."""


def random_frames(d: int, random: np.random.Generator) -> Frames:
    """Returns frames with random orientations and positions."""
    rotations, _ = np.linalg.qr(random.normal(size=(d, 3, 3)))
    rotations = rotations * np.sign(np.linalg.det(rotations))[:, None, None]
    return Frames(rotations, REACH * random.normal(size=(d, 3)))


def rough_frames(kinematic_prior: Frames, random: np.random.Generator, *, angle: float, length: float) -> Frames:
    """Perturbs prior frames: rotates them by `angle`, rad, about random axes, and moves them by `length`, m."""
    directions = random.normal(size=(2, *np.shape(kinematic_prior.positions)))
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    turns = np.asarray(jax.vmap(rotation)(jnp.asarray(angle * directions[0])))
    return Frames(
        np.asarray(kinematic_prior.rotations) @ turns, np.asarray(kinematic_prior.positions) + length * directions[1]
    )


def free_directions(parents: Sequence[int], joints: Sequence[JointKind]) -> np.ndarray:
    """Indices into a flat step [d, 6] of the coordinates that torques may identify; the others are gauges.

    A link's frame may rotate about its own z and slide along it, which leaves four coordinates: two tilts of the axis
    and two shifts across it. The axis of a prismatic joint, and of a joint on the base, has a direction but no
    position.
    """
    places = []
    for link, (parent, kind) in enumerate(zip(parents, joints, strict=True)):
        shifts = (3, 4) if kind == "revolute" and parent >= 0 else ()
        places += [6 * link + k for k in (0, 1, *shifts)]
    return np.array(places)


def displaced(frames: Frames, step: Float[Array, "d 6"]) -> Frames:
    """Rotates frames by the vectors step[:, :3], rad, and moves them by step[:, 3:], m, both in their own axes."""
    positions = frames.positions + jnp.einsum("iab,ib->ia", frames.rotations, step[:, 3:])
    return Frames(frames.rotations @ jax.vmap(rotation)(step[:, :3]), positions)


def turned_round(frames: Frames, parents: Sequence[int], joint: int) -> Frames:
    """Returns the same arm at q = 0 with one joint's direction of motion reversed.

    Where gravity dominates, torques hardly distinguish the two arms, and descents end in either.
    """
    half = np.diag([1.0, -1.0, -1.0])
    rotations, positions = (np.array(each) for each in frames)
    rotations[joint] = rotations[joint] @ half
    for link, parent in enumerate(parents):
        if parent == joint:
            rotations[link], positions[link] = half @ rotations[link], half @ positions[link]
    return Frames(rotations, positions)


def mirrored(frames: Frames, parents: Sequence[int], joints: Sequence[JointKind]) -> Frames:
    """Returns the mirror image: it moves alike under the same torques if the inertias are mirrored too.

    Reflecting x in every frame reverses the rotation of revolute joints; reversing y and z of their links restores it.
    """
    mirror, half = np.diag([-1.0, 1.0, 1.0]), np.diag([1.0, -1.0, -1.0])
    own = [half if kind == "revolute" else np.eye(3) for kind in joints]
    before = [np.eye(3) if parent < 0 else own[parent] for parent in parents]
    rotations = [
        turn @ mirror @ R @ mirror @ after for turn, R, after in zip(before, frames.rotations, own, strict=True)
    ]
    positions = [turn @ mirror @ p for turn, p in zip(before, frames.positions, strict=True)]
    return Frames(np.array(rotations), np.array(positions))
