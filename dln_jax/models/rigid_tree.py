"""A tree of rigid bodies with known frames, whose inertias, armature and friction are the parameters.

Forces are linear in them, so that `learning.linear.fit_linear(..., negligible=1e-12)` identifies all at once.

Data determine combinations of the eleven numbers a joint only ("base parameters"); a fit gives the shortest solution
that predicts the same forces, which need not be bodies that exist.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.recursive import RecursiveSystem
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.energies import tree_system
from dln_jax.models.model import Model
from dln_jax.types import require_positive


class RigidTreeParameters(NamedTuple):
    """Of a tree of d joints; friction is `None` where there is none."""

    inertias: Any
    """[d, 10], as `mechanics.trees.PARAMETERS`."""
    armature: Any
    """[d], kg m² or kg."""
    viscous: Any
    """[d], N m s or N s/m."""
    coulomb: Any
    """[d], N m or N."""
    offset: Any
    """[d], N m or N."""


def make_rigid_tree(
    tree: Tree, *, friction: bool = False, velocity_scale: float = 0.01, dtype: DTypeLike = jnp.float64
) -> Model:
    """A model with the frames of a tree.

    Args:
        tree: whose inertias and armature are where the parameters start.
        friction: viscous and dry friction and an offset of each joint are parameters too.
        velocity_scale: of dry friction, as for `mechanics.friction.joint_dissipation`; it is not fitted.
        dtype: of the parameters.

    Raises:
        InputError: a scale that is not positive.
    """
    require_positive(velocity_scale=velocity_scale)
    d = tree.degrees_of_freedom

    def init(key: Array) -> RigidTreeParameters:
        none = jnp.zeros(d, dtype) if friction else None
        return RigidTreeParameters(
            jnp.asarray(tree.inertias, dtype), jnp.asarray(tree.armature, dtype), none, none, none
        )

    def energies(parameters: RigidTreeParameters) -> RecursiveSystem:
        fitted = tree._replace(inertias=parameters.inertias, armature=parameters.armature)
        dissipation = None
        if friction:
            coefficients = parameters.viscous, parameters.coulomb, parameters.offset
            dissipation = joint_dissipation(*coefficients, velocity_scale=velocity_scale)
        return tree_system(fitted, dissipation)

    return Model(init, energies)
