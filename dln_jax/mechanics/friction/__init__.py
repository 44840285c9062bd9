"""Friction of joints: laws, their Rayleigh functions, and load-dependent friction of transmissions."""

from dln_jax.mechanics.friction.curves import joint_dissipation, joint_rates, require_shape, unit_force
from dln_jax.mechanics.friction.laws import (
    LAWS,
    FrictionCoefficients,
    FrictionShape,
    coefficients_of,
    require_laws,
    shape_of,
)

__all__ = [
    "LAWS",
    "FrictionCoefficients",
    "FrictionShape",
    "coefficients_of",
    "joint_dissipation",
    "joint_rates",
    "require_laws",
    "require_shape",
    "shape_of",
    "unit_force",
]
