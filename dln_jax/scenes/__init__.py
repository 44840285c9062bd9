"""Textbook systems: their `Needs`, exact energies and equations of motion."""

from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.scenes.chain import chain
from dln_jax.scenes.double_pendulum import double_pendulum
from dln_jax.scenes.flexible_cart_pole import flexible_cart_pole
from dln_jax.scenes.n_body import n_body
from dln_jax.scenes.oscillators import henon_heiles, mass_spring
from dln_jax.scenes.pendulum import pendulum
from dln_jax.scenes.registry import SCENES, scene_named
from dln_jax.scenes.rotary_pendulum import rotary_pendulum
from dln_jax.scenes.scene import Scene, actuation_matrix, closed_form_forward_dynamics
from dln_jax.scenes.two_link_arm import joint_angles, two_link_arm
from dln_jax.scenes.two_link_pendulum import Links, two_link_pendulum

__all__ = [
    "SCENES",
    "Links",
    "Scene",
    "actuation_matrix",
    "cart_pole",
    "chain",
    "closed_form_forward_dynamics",
    "double_pendulum",
    "flexible_cart_pole",
    "henon_heiles",
    "joint_angles",
    "mass_spring",
    "n_body",
    "pendulum",
    "rotary_pendulum",
    "scene_named",
    "two_link_arm",
    "two_link_pendulum",
]
