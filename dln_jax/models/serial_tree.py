"""Arm with unknown kinematics: joint frames, inertias, armature and friction are the parameters.

Links form a tree in a given order, a serial chain by default. Torques do not identify all six numbers of a frame. The
directions without effect ("gauges") are

- rotating a link's frame about its joint's axis, or sliding it along the axis, together with the link's inertia and the
  next frames: an axis in space has four numbers, the direction of a prismatic joint two;
- the position of the base and its angle about the vertical: only the angle between first axis and gravity counts;
- mirroring the whole arm, with axes as pseudo-vectors: torques cannot distinguish left-handed from right-handed arms.

`learning.kinematics.fit_tree` fits the parameters.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.closed_form import RecursiveSystem
from dln_jax.mechanics.friction.curves import joint_dissipation
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model
from dln_jax.types import InputError, Needs, require_positive


class SerialTreeParameters(NamedTuple):
    """Parameters of an arm of d joints; absent friction is `None`."""

    turns: Any
    """[d, 3], rotation vectors of the links' frames relative to the parent link at q = 0, rad."""
    positions: Any
    """[d, 3], m."""
    inertias: Any
    """[d, 10], as `mechanics.trees.PARAMETERS`; identifiable combinations, which need not be physically consistent."""
    armature: Any
    """[d], kg m² or kg."""
    viscous: Any
    """[d], N m s or N s/m."""
    coulomb: Any
    """[d], N m or N."""
    offset: Any
    """[d], N m or N."""


def make_serial_tree(
    needs: Needs,
    *,
    parents: Sequence[int] | None = None,
    acceleration: float = 9.81,
    velocity_scale: float = 0.01,
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns a tree of the needed joints whose frames are parameters.

    Args:
        needs: kinds of joints, gravity and friction (viscous, dry and an offset in every joint).
        parents: parent link of every link, -1 for the ground; by default the one before.
        acceleration: acceleration of gravity, m/s².
        velocity_scale: velocity scale of dry friction, as for `mechanics.friction.joint_dissipation`; it is not fitted.

    Raises:
        InputError: parents are not earlier links, an acceleration or scale is not positive, or the needs have an
            actuation matrix, a joint map or joint friction laws.
    """
    require_positive(acceleration=acceleration, velocity_scale=velocity_scale)
    if needs.actuation is not None:
        raise InputError("a learned tree has a motor at each joint; leave actuation out of the needs")
    if needs.joint_map is not None:
        raise InputError("a learned tree takes coordinates of its joints; leave joint_map out of the needs")
    if needs.joint_friction:
        raise InputError(
            "a learned tree has viscous, dry and offset friction: state friction in its needs, and no joint_friction"
        )
    d = needs.degrees_of_freedom
    order = tuple(range(-1, d - 1)) if parents is None else tuple(parents)
    if len(order) != d or any(not -1 <= parent < link for link, parent in enumerate(order)):
        raise InputError(f"parents are {order}; expected for each of {d} links one before it, or -1 for the ground")

    def init(key: Array) -> SerialTreeParameters:
        turns, positions = jax.random.normal(key, (2, d, 3), dtype)
        body = jnp.asarray([1.0, 0, 0, 0, 0.02, 0, 0, 0.02, 0, 0.02], dtype)
        none = jnp.zeros(d, dtype) if needs.friction else None
        inertias, armature = jnp.tile(body, (d, 1)), jnp.full(d, 0.01, dtype)
        return SerialTreeParameters(turns, 0.15 * positions, inertias, armature, none, none, none)

    def energies(parameters: SerialTreeParameters) -> RecursiveSystem:
        dissipation = None
        if needs.friction:
            coefficients = parameters.viscous, parameters.coulomb, parameters.offset
            dissipation = joint_dissipation(*coefficients, velocity_scale=velocity_scale)
        tree = tree_of(parameters, needs, parents=order, acceleration=acceleration)
        return tree_system(tree, dissipation)

    return Model(init, energies)


def tree_of(
    parameters: SerialTreeParameters,
    needs: Needs,
    *,
    parents: Sequence[int] | None = None,
    acceleration: float = 9.81,
) -> Tree:
    """Returns the tree of these parameters, like one with known frames; other arguments as for `make_serial_tree`."""
    d = needs.degrees_of_freedom
    return Tree(
        parents=tuple(range(-1, d - 1)) if parents is None else tuple(parents),
        joints=needs.joints,
        rotations=jax.vmap(rotation)(jnp.asarray(parameters.turns)),
        positions=parameters.positions,
        axes=np.tile([0.0, 0.0, 1.0], (d, 1)),
        inertias=parameters.inertias,
        armature=parameters.armature,
        gravity=np.array([0.0, 0.0, -acceleration if needs.gravity else 0.0]),
    )


def rotation(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Returns the rotation matrix exp of a rotation vector, by Rodrigues' formula, smooth at zero."""
    x, y, z = turn
    zero = jnp.zeros_like(x)
    hat = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    square = turn @ turn
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    return jnp.eye(3, dtype=turn.dtype) + first * hat + second * hat @ hat


def rotation_vector(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Returns the shortest rotation vector of a `rotation`, by its quaternion, which is accurate at half turns too."""
    trace = np.trace(matrix)
    places = np.array([trace, *np.diag(matrix)])
    largest = int(np.argmax(places))
    skew = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    if largest == 0:
        w, xyz = 1 + trace, skew
    else:
        i = largest - 1
        w = skew[i]
        xyz = matrix[i] + matrix[:, i]
        xyz[i] = 1 - trace + 2 * matrix[i, i]
    length = np.linalg.norm(xyz)
    if length == 0:
        return np.zeros(3)
    sign = 1.0 if w >= 0 else -1.0
    return sign * xyz * (2 * np.arctan2(length, abs(w)) / length)
