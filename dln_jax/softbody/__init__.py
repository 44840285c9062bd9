"""Soft bodies: meshes, energy terms, and implicit time steps that are minimisations of an incremental potential.

`mesh` makes bodies and `terms` what acts on them; a scene holds both, and `make_step` gives its time step.
"""

from dln_jax.rollout import rollout
from dln_jax.softbody.driven import Drive, Example, drive, driven_step
from dln_jax.softbody.scene import Params, SoftScene, State, make_scene, potential, with_parameters
from dln_jax.softbody.step import (
    BACKWARD_EULER,
    BDF2,
    MIDPOINT,
    Integrator,
    Stepper,
    make_step,
    positions_and_convergence,
    static_solve,
)
from dln_jax.softbody.verdict import Info

__all__ = [
    "BACKWARD_EULER",
    "BDF2",
    "MIDPOINT",
    "Drive",
    "Example",
    "Info",
    "Integrator",
    "Params",
    "SoftScene",
    "State",
    "Stepper",
    "drive",
    "driven_step",
    "make_scene",
    "make_step",
    "positions_and_convergence",
    "potential",
    "rollout",
    "static_solve",
    "with_parameters",
]
