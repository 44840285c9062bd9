"""Frames of a tree's links, and vectors between them.

All joints are about z of their link: `aligned` rotates links accordingly. Permuting axes costs only signs.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.inertia import moved
from dln_jax.types import InputError, Vector

Vector3 = Float[Array, "3"]


class Placed(NamedTuple):
    """Frame of a link relative to its parent link, at one state."""

    rotation: Any
    """[3, 3] at q = 0."""
    turned: tuple[Array, Array] | None
    """Cosine and sine of the joint's angle; `None` for a prismatic joint."""
    position: Any
    """[3]."""


def aligned(tree: Tree) -> Tree:
    """Returns the same tree with every joint about z of its link's frame; the frames and payloads of links change."""
    about_z = np.tile([0.0, 0.0, 1.0], (len(tree.axes), 1))
    if not isinstance(tree.axes, np.ndarray) or np.array_equal(tree.axes, about_z):
        return tree
    turns = [_onto(axis) for axis in tree.axes]
    rotations, positions = [], []
    for link, parent in enumerate(tree.parents):
        # In the original frame of the parent, then in its rotated frame.
        rotation, position = tree.rotations[link] @ turns[link], tree.positions[link]
        back = np.eye(3) if parent < 0 else turns[parent].T
        rotations.append(back @ rotation)
        positions.append(back @ position)
    inertias = [moved(theta, turn.T, np.zeros(3)) for theta, turn in zip(tree.inertias, turns, strict=True)]
    numpy = np if all(isinstance(part, np.ndarray) for part in (*rotations, *positions, *inertias)) else jnp
    rotations, positions, inertias = (numpy.stack(parts) for parts in (rotations, positions, inertias))
    return tree._replace(rotations=rotations, positions=positions, inertias=inertias, axes=about_z)


def _onto(axis: np.ndarray) -> np.ndarray:
    """Returns a rotation with the axis as third column; its entries are integers if the axis is one of the frame's
    own."""
    place = int(np.argmax(np.abs(axis)))
    first = np.eye(3)[(place + 1) % 3]
    first = first - axis * (axis @ first)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis], axis=1) + 0.0


def placed(tree: Tree, q: Vector) -> list[Placed]:
    """Returns the frames of the links of an aligned tree relative to their parent links."""
    frames = []
    for link, kind in enumerate(tree.joints):
        rotation, position = tree.rotations[link], tree.positions[link]
        if kind == "revolute":
            frames.append(Placed(rotation, (jnp.cos(q[link]), jnp.sin(q[link])), position))
        else:
            frames.append(Placed(rotation, None, position + rotation[:, 2] * q[link]))
    return frames


def outwards(frame: Placed, vector: Vector3) -> Vector3:
    """Maps a vector from the parent's frame to the link's."""
    x, y, z = _product(frame.rotation.T, vector)
    if frame.turned is None:
        return jnp.stack([x, y, z])
    c, s = frame.turned
    return jnp.stack([c * x + s * y, c * y - s * x, z])


def inwards(frame: Placed, vector: Vector3) -> Vector3:
    """Maps a vector from the link's frame to the parent's."""
    if frame.turned is not None:
        c, s = frame.turned
        x, y, z = vector
        vector = jnp.stack([c * x - s * y, s * x + c * y, z])
    return jnp.stack(_product(frame.rotation, vector))


def _product(matrix: Any, vector: Vector3) -> list[Any]:
    """Multiplies a matrix by a vector element by element, without terms that are known to be zero."""
    if not isinstance(matrix, np.ndarray):
        return list(matrix @ vector)
    rows = []
    for row in matrix:
        terms = [
            vector[k] if factor == 1 else -vector[k] if factor == -1 else factor * vector[k]
            for k, factor in enumerate(row.tolist())
            if factor != 0
        ]
        rows.append(sum(terms[1:], start=terms[0]))
    return rows


def cross(a: Any, b: Any) -> Vector3:
    """Returns a x b, without terms that are known to be zero."""

    def product(x: Any, y: Any) -> Any:
        return None if _is_zero(x) or _is_zero(y) else x * y

    def difference(i: int, j: int) -> Any:
        plus, minus = product(a[i], b[j]), product(a[j], b[i])
        if minus is None:
            return 0.0 if plus is None else plus
        return -minus if plus is None else plus - minus

    return jnp.stack([jnp.asarray(difference(*pair)) for pair in ((1, 2), (2, 0), (0, 1))])


def hat(v: Vector3) -> Float[Array, "3 3"]:
    """Returns the matrix of v x."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])


def _is_zero(number: Any) -> bool:
    return isinstance(number, float | np.floating) and bool(number == 0)


def world_frames(tree: Tree, q: Vector) -> tuple[Float[Array, "d 3 3"], Float[Array, "d 3"]]:
    """Returns rotations and origins of the links' own frames in the ground's frame, for figures and tool points."""
    rotations: list[Any] = []
    origins: list[Any] = []
    for link, (parent, kind) in enumerate(zip(tree.parents, tree.joints, strict=True)):
        axis = jnp.asarray(tree.axes[link], q.dtype)
        rotation = jnp.asarray(tree.rotations[link], q.dtype)
        position = jnp.asarray(tree.positions[link], q.dtype)
        if kind == "revolute":  # by Rodrigues' formula
            K = hat(axis)
            rotation = rotation @ (jnp.eye(3, dtype=q.dtype) + jnp.sin(q[link]) * K + (1 - jnp.cos(q[link])) * K @ K)
        else:
            position = position + rotation @ (axis * q[link])
        if parent >= 0:
            position = origins[parent] + rotations[parent] @ position
            rotation = rotations[parent] @ rotation
        rotations.append(rotation)
        origins.append(position)
    return jnp.stack(rotations), jnp.stack(origins)


def frame_jacobian(tree: Tree, link: int, point: Any = (0.0, 0.0, 0.0)) -> Callable[[Vector], Float[Array, "6 d"]]:
    """Returns q -> J with (velocity of a point of a link, angular velocity of the link) = J qd, in the ground's frame.

    Its transpose maps a force and a moment on the link, about the point, to joint torques.

    Args:
        point: position in the link's own frame, m.

    Raises:
        InputError: there is no such link.
    """
    if not 0 <= link < len(tree.joints):
        raise InputError(f"link is {link}; expected one of 0 to {len(tree.joints) - 1}")
    above = [link]
    while tree.parents[above[-1]] >= 0:
        above.append(tree.parents[above[-1]])

    def jacobian(q: Vector) -> Float[Array, "6 d"]:
        rotations, origins = world_frames(tree, q)
        at = origins[link] + rotations[link] @ jnp.asarray(point, q.dtype)
        columns = [jnp.zeros(6, q.dtype)] * len(tree.joints)
        for joint in above:
            axis, none = rotations[joint] @ jnp.asarray(tree.axes[joint], q.dtype), jnp.zeros(3, q.dtype)
            turning = jnp.concatenate([jnp.cross(axis, at - origins[joint]), axis])
            columns[joint] = turning if tree.joints[joint] == "revolute" else jnp.concatenate([axis, none])
        return jnp.stack(columns, axis=1)

    return jacobian
