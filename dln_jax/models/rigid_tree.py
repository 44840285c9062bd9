"""Tree of rigid bodies with known frames; its inertias, armature and friction are the parameters.

Forces are linear in them, so that `learning.linear.fit_linear(..., negligible=1e-12)` identifies all at once.
Data determine only combinations of the eleven numbers per joint ("base parameters"). A fit returns the shortest
solution that predicts the same forces, which need not be physically consistent.

Forces are not linear in the shape of friction and the share of load. They are fixed when the model is built;
`learning.friction.fit_friction` fits them.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.friction import (
    FrictionCoefficients,
    FrictionShape,
    coefficients_of,
    joint_dissipation,
    require_laws,
    require_shape,
)
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model
from dln_jax.types import FrictionLaw, InputError

USUAL: tuple[FrictionLaw, ...] = ("viscous", "coulomb", "offset")
"""Friction laws of `friction=True`."""
Number = float | tuple[float, ...]
"""One number for all joints, or one per joint."""


class RigidTreeParameters(NamedTuple):
    """All parameters of a tree of d joints that forces are linear in. Absent friction is `None`."""

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
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns a model with the frames of a tree.

    Args:
        tree: its inertias and armature are the initial parameters; friction is initially zero.
        friction: laws whose coefficients are also parameters, as in `mechanics.friction.laws`; True: `USUAL`.
        velocity_scale, stribeck_velocity, sigmoid_slope, sigmoid_shift: as in `FrictionShape`; they are not fitted.
        load: share of the load law, 0 <= μ < 1; not fitted. With it, forces are not linear in the parameters.
        dtype: type of the parameters.

    Raises:
        InputError: an unknown law, two laws for the same friction, a velocity or slope that is not positive, or a share
            outside [0, 1), or without its law.
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

    def init(key: Array) -> RigidTreeParameters:
        none = {name: jnp.zeros(d, dtype) for name in names}
        return RigidTreeParameters(jnp.asarray(tree.inertias, dtype), jnp.asarray(tree.armature, dtype), **none)

    def energies(parameters: RigidTreeParameters) -> Any:
        fitted = tree._replace(inertias=parameters.inertias, armature=parameters.armature)
        dissipation = joint_dissipation(**parameters.friction._asdict(), **shape._asdict()) if names else None
        carried = Load(jnp.asarray(load), shape.velocity_scale) if any(shares) else None
        return with_friction(tree_system(fitted), dissipation, carried)

    return Model(init, energies)
