"""The laws of friction side by side."""

import jax.numpy as jnp
from matplotlib.figure import Figure

from dln_jax.figures.joints import friction_curves
from dln_jax.mechanics.friction import FrictionShape, unit_force
from dln_jax.mechanics.joint_friction import Load, carrying


def friction_laws() -> Figure:
    """Every law with typical coefficients, over the rate of one joint: `docs/friction.png`."""
    shape = FrictionShape(velocity_scale=0.02, stribeck_velocity=0.15, sigmoid_slope=12.0, sigmoid_shift=0.05)
    rates = jnp.linspace(-0.6, 0.6, 1201)
    sums: dict[str, dict[str, float]] = {
        "viscous": {"viscous": 1.0},
        "coulomb": {"coulomb": 0.5},
        "coulomb + stribeck": {"coulomb": 0.5, "stribeck": 0.4},
        "asymmetric": {
            "viscous_forward": 0.2,
            "viscous_backward": 0.9,
            "coulomb_forward": 0.35,
            "coulomb_backward": 0.15,
        },
        "sigmoid": {"sigmoid": 1.0},
        "offset": {"offset": 0.05},
    }
    forces = {
        name: jnp.sum(jnp.stack([size * unit_force(law, rates, shape) for law, size in parts.items()]), axis=0)
        for name, parts in sums.items()
    }
    link = jnp.ones_like(rates)
    forces["load, 1 N m carried"] = carrying(Load(0.25, shape.velocity_scale), rates, link) - link
    return friction_curves({name: (rates[:, None], force[:, None]) for name, force in forces.items()})
