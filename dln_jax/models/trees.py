"""Trees of rigid bodies: their inertias, armature and friction, and frames that are not known, are the parameters.

With known frames forces are linear in these parameters, so `learning.linear.fit_linear(..., negligible=1e-12)`
identifies all at once. Data determine only combinations of the eleven numbers per joint ("base parameters"). A fit
returns the shortest solution that predicts the same forces, which need not be physically consistent.

Forces are not linear in the shape of friction, the share of load and the cooling coefficient, which are fixed when the
model is built; `learning.friction.fit_friction` fits them. Viscous friction of warm grease is lower:

    b(T) = b exp(-k (T - T_ref))

For motors that turn with several joints, and armature as a matrix, see `mechanics.trees.motors`.

In an arm with unknown kinematics the joint frames are parameters too (`make_serial_tree`). Links form a tree in a given
order, a serial chain by default. Torques do not identify all six numbers of a frame. The
directions without effect ("gauges") are

- rotating a link's frame about its joint's axis, or sliding it along the axis, together with the link's inertia and the
  next frames: an axis in space has four numbers, the direction of a prismatic joint two;
- the position of the base and its angle about the vertical: only the angle between first axis and gravity counts;
- mirroring the whole arm, with axes as pseudo-vectors: torques cannot distinguish left-handed from right-handed arms.

`learning.kinematics.fit.fit_tree` fits these parameters.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.friction import (
    USUAL,
    FrictionCoefficients,
    FrictionShape,
    coefficients_of,
    joint_dissipation,
    require_laws,
    require_shape,
)
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.frames import hat
from dln_jax.mechanics.trees.motors import Pair, armature_matrix, motors_of, require_motors
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model
from dln_jax.types import FrictionLaw, InputError, Needs, require_positive

Number = float | tuple[float, ...]
"""One number for all joints, or one per joint."""
Rows = tuple[tuple[float, ...], ...]
WARM = ("viscous", "viscous_forward", "viscous_backward")
"""Coefficients that depend on temperature."""


class RigidTreeParameters(NamedTuple):
    """All parameters of a tree of d joints; forces are linear in them. Absent friction is `None`."""

    inertias: Any
    """[d, 10], as `mechanics.trees.inertia.PARAMETERS`."""
    armature: Any
    """[d], kg m² or kg."""
    viscous: Any = None
    """[d], like the coefficients below, as in `FrictionCoefficients`."""
    coulomb: Any = None
    offset: Any = None
    stribeck: Any = None
    viscous_forward: Any = None
    viscous_backward: Any = None
    coulomb_forward: Any = None
    coulomb_backward: Any = None
    sigmoid: Any = None
    coupling: Any = None
    """Entries C_ij of the armature between motors, by "i_j" with joints counted from 1, kg m² or kg."""

    @property
    def friction(self) -> FrictionCoefficients:
        """Friction coefficients of the joints."""
        return FrictionCoefficients(**{name: getattr(self, name) for name in FrictionCoefficients._fields})


def make_rigid_tree(
    tree: Tree,
    *,
    friction: bool | tuple[FrictionLaw, ...] = False,
    velocity_scale: Number = 0.01,
    stribeck_velocity: Number = 0.1,
    sigmoid_slope: Number = 10.0,
    sigmoid_shift: Number = 0.0,
    load: Number = 0.0,
    cooling: Number = 0.0,
    reference_temperature: float = 25.0,
    temperature: float | None = None,
    motors: Rows | None = None,
    coupled: tuple[Pair, ...] = (),
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns a model with the frames of a tree.

    Args:
        tree: its inertias and armature are the initial parameters; friction is initially zero.
        friction: laws whose coefficients are also parameters, as in `mechanics.friction`; True: `USUAL`.
        velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift: as in `FrictionShape`; they are not fitted.
        load: share of the load law, 0 <= μ < 1; not fitted. With it, forces are not linear in the parameters.
        cooling: k, 1/K; not fitted.
        reference_temperature: T_ref of the viscous coefficients, °C.
        temperature: T, °C, of all functions (default: T_ref). `energies(parameters, T)` takes another, also per joint.
        motors: rows of S in motor rates S qd; armature and friction act on the motors. By default one per joint.
        coupled: pairs of motors, counted from 0, with an off-diagonal entry of the armature, which is a parameter.

    Raises:
        InputError: a law is unknown, two laws describe the same friction, a velocity or slope is not positive, a share
            is outside [0, 1) or lacks its law, cooling lacks viscous friction, motors do not determine the joints'
            rates, or the tree's armature is impossible with these motors.
    """
    laws = USUAL if friction is True else friction or ()
    require_laws(laws, "friction")
    shape = FrictionShape(velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift)
    shape = FrictionShape(*(np.asarray(value) if isinstance(value, tuple) else value for value in shape))
    require_shape(shape)
    shares = np.ravel(load)
    if not all(0 <= share < 1 for share in shares):
        raise InputError(f"load is {load}; expected a share of at least 0 and less than 1, or one for each joint")
    if any(shares) and "load" not in laws:
        raise InputError(f"load is {load}, but friction has {', '.join(laws) or 'no law'}; add 'load' to friction")
    d = tree.degrees_of_freedom
    names = coefficients_of(laws)
    cools = np.any(cooling)
    if cools and not set(names) & set(WARM):
        raise InputError(f"cooling is {cooling}, but friction has {', '.join(laws) or 'no law'}; add 'viscous' to it")
    require_motors(motors, coupled, d)
    own, entries = motors_of(tree.armature, motors, coupled)

    def init(key: Array) -> RigidTreeParameters:
        more: dict[str, Any] = {name: jnp.zeros(d, dtype) for name in names}
        if coupled:
            keys = (f"{i + 1}_{j + 1}" for i, j in coupled)
            more["coupling"] = {key: jnp.asarray(entry, dtype) for key, entry in zip(keys, entries, strict=True)}
        return RigidTreeParameters(jnp.asarray(tree.inertias, dtype), jnp.asarray(own, dtype), **more)

    def energies(parameters: RigidTreeParameters, at: Any = temperature) -> Any:
        armature = armature_matrix(parameters.armature, motors, pairs_of(parameters.coupling))
        fitted = tree._replace(inertias=parameters.inertias, armature=armature)
        coefficients = parameters.friction._asdict()
        if cools and at is not None:
            factor = jnp.exp(-jnp.asarray(cooling) * (at - reference_temperature))
            coefficients |= {name: factor * value for name in WARM if (value := coefficients[name]) is not None}
        dissipation = joint_dissipation(**coefficients, **shape._asdict(), joint_map=motors) if names else None
        carried = Load(jnp.asarray(load), shape.velocity_scale, motors) if any(shares) else None
        return with_friction(tree_system(fitted), dissipation, carried)

    return Model(init, energies)


def pairs_of(coupling: dict[str, Any] | None) -> dict[Pair, Any]:
    """Returns the entries of the armature by pairs of motors counted from 0."""
    named = (coupling or {}).items()
    return {(int(key.partition("_")[0]) - 1, int(key.partition("_")[2]) - 1): value for key, value in named}


class SerialTreeParameters(NamedTuple):
    """Parameters of an arm of d joints; absent friction is `None`."""

    turns: Any
    """[d, 3], rotation vectors of the links' frames relative to the parent link at q = 0, rad."""
    positions: Any
    """[d, 3], m."""
    inertias: Any
    """[d, 10], as `mechanics.trees.inertia.PARAMETERS`; identifiable combinations, maybe physically inconsistent."""
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
    for name, remedy in (
        ("actuation", "has a motor at each joint; leave actuation out of the needs"),
        ("joint_map", "takes coordinates of its joints; leave joint_map out of the needs"),
        (
            "joint_friction",
            "has viscous, dry and offset friction: state friction in its needs, and no joint_friction",
        ),
    ):
        if getattr(needs, name):
            raise InputError(f"a learned tree {remedy}")
    d = needs.degrees_of_freedom
    if parents is not None and (
        len(parents) != d or any(not -1 <= parent < link for link, parent in enumerate(parents))
    ):
        raise InputError(
            f"parents are {tuple(parents)}; expected for each of {d} links one before it, or -1 for the ground"
        )

    def init(key: Array) -> SerialTreeParameters:
        turns, positions = jax.random.normal(key, (2, d, 3), dtype)
        body = jnp.asarray([1.0, 0, 0, 0, 0.02, 0, 0, 0.02, 0, 0.02], dtype)
        none = jnp.zeros(d, dtype) if needs.friction else None
        inertias, armature = jnp.tile(body, (d, 1)), jnp.full(d, 0.01, dtype)
        return SerialTreeParameters(turns, 0.15 * positions, inertias, armature, none, none, none)

    def energies(parameters: SerialTreeParameters) -> ExplicitSystem:
        coefficients = parameters.viscous, parameters.coulomb, parameters.offset
        dissipation = joint_dissipation(*coefficients, velocity_scale=velocity_scale)
        return tree_system(tree_of(parameters, needs, parents=parents, acceleration=acceleration), dissipation)

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
    K = hat(turn)
    square = turn @ turn
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    first = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    second = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    return jnp.eye(3, dtype=turn.dtype) + first * K + second * K @ K
