"""Rigid bodies in a tree of revolute and prismatic joints: a description, its energies, and recursions over it.

`tree_system(tree)` is a record for `mechanics.equations.dynamics`; `lagrangian(tree)` is its Lagrangian.
"""

from dln_jax.mechanics.trees.description import (
    Tree,
    dh_frames,
    make_tree,
    serial,
    tree_from_json,
    tree_to_json,
    with_payload,
)
from dln_jax.mechanics.trees.frames import frame_jacobian, world_frames
from dln_jax.mechanics.trees.inertia import (
    PARAMETERS,
    body_of_pseudo_inertia,
    inertial_parameters,
    moved,
    pseudo_inertia,
)
from dln_jax.mechanics.trees.motors import armature_matrix
from dln_jax.mechanics.trees.recursions import (
    composite_bodies,
    kinetic_energy,
    lagrangian,
    newton_euler,
    potential_energy,
    regressor,
    tree_energies,
    tree_system,
)

__all__ = [
    "PARAMETERS",
    "Tree",
    "armature_matrix",
    "body_of_pseudo_inertia",
    "composite_bodies",
    "dh_frames",
    "frame_jacobian",
    "inertial_parameters",
    "kinetic_energy",
    "lagrangian",
    "make_tree",
    "moved",
    "newton_euler",
    "potential_energy",
    "pseudo_inertia",
    "regressor",
    "serial",
    "tree_energies",
    "tree_from_json",
    "tree_system",
    "tree_to_json",
    "with_payload",
    "world_frames",
]
