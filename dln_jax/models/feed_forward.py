"""Feed-forward networks for inverse and forward dynamics: the baseline that knows no physics.

    tau = tau_scale network([features(q), qd / rate_scale, qdd / acceleration_scale])
    qdd = acceleration_scale network([features(q), qd / rate_scale, tau / tau_scale])

The two networks are separate, so that one need not invert the other. There is no energy and no mass matrix.
"""

from functools import partial

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.mechanics.plain import InverseForward
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.features import joint_features, unsaturated
from dln_jax.models.model import Model, model_of
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Needs, Vector, require_positive


def make_feed_forward(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    rate_scale: Scale = 1.0,
    acceleration_scale: Scale = 1.0,
    tau_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of the two networks; forces are not told apart, so that an absent one leaves nothing out.

    Args:
        rate_scale: typical size of qd.
        acceleration_scale: typical size of qdd.
        tau_scale: typical size of tau.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(width=width, depth=depth)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    accelerations = per_coordinate(needs, "acceleration_scale", acceleration_scale)
    forces = per_coordinate(needs, "tau_scale", tau_scale)

    def network(name: str, sizes: tuple[float, ...], output: tuple[float, ...], q: Vector, qd: Vector, x: Vector):
        scaled = [unsaturated(qd / jnp.asarray(rates, qd.dtype)), unsaturated(x / jnp.asarray(sizes, x.dtype))]
        layers = hk.nets.MLP([width] * depth + [len(output)], activation=activation.value, name=name)
        return jnp.asarray(output, qd.dtype) * layers(jnp.concatenate([joint_features(needs, q), *scaled]))

    def terms():
        inverse = partial(network, "inverse", accelerations, forces)
        return {"inverse_dynamics": inverse, "forward_dynamics": partial(network, "forward", forces, accelerations)}

    return model_of(InverseForward, terms, np.zeros(needs.degrees_of_freedom), dtype)
