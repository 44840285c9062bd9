"""Textbook systems: their `Needs`, exact energies and equations of motion."""

from dln_jax.scenes.particles import henon_heiles, mass_spring, n_body
from dln_jax.scenes.pendulums import (
    Links,
    chain,
    double_pendulum,
    joint_angles,
    pendulum,
    two_link_arm,
    two_link_pendulum,
)
from dln_jax.scenes.poles import cart_pole, flexible_cart_pole, rotary_pendulum
from dln_jax.scenes.registry import SCENES, scene_named
from dln_jax.scenes.scene import Scene, actuation_matrix, closed_form_forward_dynamics

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
