"""Parts of models: features of the coordinates, networks, scales of their inputs, and friction."""

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.nn.activations import Activation
from dln_jax.types import InputError, Needs, Scalar, Vector, require_positive

Scale = float | tuple[float, ...]
"""Typical size of a quantity, in its unit: one number, or one per coordinate."""


def joint_features(needs: Needs, q: Vector) -> Float[Array, " features"]:
    """cos and sin of revolute joints, so that a full turn changes nothing; prismatic joints enter directly.

    A kind of joint that the scene lacks adds no operation.
    """
    revolute = np.array([joint == "revolute" for joint in needs.joints])
    angles = q[np.flatnonzero(revolute)]
    features = [jnp.cos(angles), jnp.sin(angles)] if revolute.any() else []
    if not revolute.all():
        features.append(unsaturated(q[np.flatnonzero(~revolute)]))
    return jnp.concatenate(features)


def unsaturated(x: Float[Array, " inputs"]) -> Float[Array, " inputs"]:
    """Returns x, with NaN in place of infinities, for which a saturated network would return a plausible number."""
    return x + 0 * x


def perceptron(name: str, width: int, depth: int, outputs: int, activation: Activation) -> hk.nets.MLP:
    """`depth` hidden layers of `width` units and a linear output; inside a transformed function."""
    return hk.nets.MLP([width] * depth + [outputs], activation=activation.value, name=name)


def viscous_dissipation(q: Vector, qd: Vector) -> Scalar:
    """D = ½ Σ b qd², with one learned coefficient b = softplus(x) > 0 per coordinate; inside a transformed function."""
    coefficients = hk.get_parameter("viscous_friction", qd.shape, qd.dtype, hk.initializers.Constant(-3.0))
    return 0.5 * jnp.sum(jax.nn.softplus(coefficients) * qd**2)


def per_coordinate(needs: Needs, name: str, scale: Scale) -> tuple[float, ...]:
    """Returns one positive size per coordinate; raises InputError otherwise."""
    d = needs.degrees_of_freedom
    sizes = scale if isinstance(scale, tuple) else (scale,) * d
    if len(sizes) != d:
        raise InputError(f"{name} has {len(sizes)} sizes; expected one number, or one for each of {d} coordinates")
    for size in sizes:
        require_positive(**{name: size})
    return sizes
