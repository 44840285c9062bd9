"""What a network sees of the coordinates."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.types import Needs, Vector


def joint_features(needs: Needs, q: Vector) -> Float[Array, " features"]:
    """cos and sin of revolute joints, so that a full turn changes nothing; prismatic joints as they are.

    A kind of joint that the scene lacks contributes no operation.
    """
    revolute = np.array([joint == "revolute" for joint in needs.joints])
    angles = q[np.flatnonzero(revolute)]
    features = [jnp.cos(angles), jnp.sin(angles)] if revolute.any() else []
    if not revolute.all():
        features.append(unsaturated(q[np.flatnonzero(~revolute)]))
    return jnp.concatenate(features)


def unsaturated(x: Float[Array, " inputs"]) -> Float[Array, " inputs"]:
    """x itself, and NaN for an infinity, which a network that saturates would answer with a plausible number."""
    return x + 0 * x
