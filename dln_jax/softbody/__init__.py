"""Soft bodies: meshes, energy terms and implicit time steps that minimise an incremental potential.

`mesh` builds bodies and `terms` their energies. A scene holds both, and `make_step` returns its time step.
"""

from dln_jax.rollout import rollout
from dln_jax.softbody.driven import Drive, Example, drive, driven_step
from dln_jax.softbody.equilibrium import static_solve
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, BDF2, MIDPOINT, Integrator
from dln_jax.softbody.scene import Params, SoftScene, State, make_scene, potential, with_parameters
from dln_jax.softbody.step import Stepper, make_step, positions_and_convergence
from dln_jax.softbody.ties import Tie, TiedState, make_tied_step
from dln_jax.softbody.verdict import Info

__all__ = [
    "AVERAGE_VECTOR_FIELD",
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
    "Tie",
    "TiedState",
    "drive",
    "driven_step",
    "make_scene",
    "make_step",
    "make_tied_step",
    "positions_and_convergence",
    "potential",
    "rollout",
    "static_solve",
    "with_parameters",
]
