"""Tree of rigid bodies with known frames; its inertias, armature and friction are the parameters.

Forces are linear in these parameters, so `learning.linear.fit_linear(..., negligible=1e-12)` identifies all at once.
Data determine only combinations of the eleven numbers per joint ("base parameters"). A fit returns the shortest
solution that predicts the same forces, which need not be physically consistent.

Forces are not linear in the shape of friction, the share of load and the cooling coefficient, which are fixed when the
model is built; `learning.friction.fit_friction` fits them. Viscous friction of warm grease is lower:

    b(T) = b exp(-k (T - T_ref))

For motors that turn with several joints, and armature as a matrix, see `mechanics.trees.motors`.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.friction.curves import joint_dissipation, require_shape
from dln_jax.mechanics.friction.laws import USUAL, FrictionCoefficients, FrictionShape, coefficients_of, require_laws
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair, armature_matrix, motors_of, require_motors
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model
from dln_jax.types import FrictionLaw, InputError

Number = float | tuple[float, ...]
"""One number for all joints, or one per joint."""
Rows = tuple[tuple[float, ...], ...]
WARM = ("viscous", "viscous_forward", "viscous_backward")
"""Coefficients that depend on temperature."""


class RigidTreeParameters(NamedTuple):
    """All parameters of a tree of d joints; forces are linear in them. Absent friction is `None`."""

    inertias: Any
    """[d, 10], as `mechanics.trees.PARAMETERS`."""
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
        friction: laws whose coefficients are also parameters, as in `mechanics.friction.laws`; True: `USUAL`.
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
    shares = load if isinstance(load, tuple) else (load,)
    if not all(0 <= share < 1 for share in shares):
        raise InputError(f"load is {load}; expected a share of at least 0 and less than 1, or one for each joint")
    if any(shares) and "load" not in laws:
        raise InputError(f"load is {load}, but friction has {', '.join(laws) or 'no law'}; add 'load' to friction")
    d = tree.degrees_of_freedom
    names = coefficients_of(laws)
    cools = any(cooling) if isinstance(cooling, tuple) else bool(cooling)
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
