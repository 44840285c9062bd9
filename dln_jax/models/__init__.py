"""Models: energies built from networks and bases for the needs of a scene."""

from dln_jax.models.baselines import make_feed_forward, make_phase_network
from dln_jax.models.hamiltonian import (
    make_black_box_hamiltonian,
    make_dissipative,
    make_separable_hamiltonian,
    make_structured_hamiltonian,
)
from dln_jax.models.joint_friction import FrictionParameters, friction_of, with_joint_friction
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.models.latent_phase import make_latent_phase
from dln_jax.models.model import Model, Parameters
from dln_jax.models.n_body import make_pairwise_hamiltonian
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.models.polynomial_hamiltonian import make_polynomial_hamiltonian
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.models.serial_tree import make_serial_tree
from dln_jax.models.trigonometric import make_trigonometric
from dln_jax.models.trigonometric_kernel import make_trigonometric_kernel

__all__ = [
    "FrictionParameters",
    "Model",
    "Parameters",
    "friction_of",
    "make_black_box_hamiltonian",
    "make_black_box_lagrangian",
    "make_delan",
    "make_dissipative",
    "make_feed_forward",
    "make_latent_phase",
    "make_pairwise_hamiltonian",
    "make_phase_network",
    "make_planar_chain",
    "make_polynomial_hamiltonian",
    "make_rigid_tree",
    "make_separable_hamiltonian",
    "make_serial_tree",
    "make_structured_hamiltonian",
    "make_trigonometric",
    "make_trigonometric_kernel",
    "with_joint_friction",
]
