"""A network for the rates of a phase space, which knows no physics: the baseline that Greydanus, Dzamba and Yosinski
(2019) compare with.

    (qd, pd) = rate_scale network([features(q), p / momentum_scale])
"""

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.mechanics.plain import PhaseRates
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.features import joint_features, unsaturated
from dln_jax.models.model import Model, model_of
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Needs, Vector, require_positive


def make_phase_network(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    momentum_scale: Scale = 1.0,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of the baseline; forces are not told apart.

    Args:
        momentum_scale: typical size of p.
        rate_scale: typical size of qd and pd.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(width=width, depth=depth)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    d = needs.degrees_of_freedom

    def network(q: Vector, p: Vector):
        inputs = jnp.concatenate([joint_features(needs, q), unsaturated(p / jnp.asarray(momenta, p.dtype))])
        layers = hk.nets.MLP([width] * depth + [2 * d], activation=activation.value, name="rates")
        outputs = layers(inputs) * jnp.asarray(rates * 2, p.dtype)
        return outputs[:d], outputs[d:]

    return model_of(PhaseRates, lambda: {"rates": network}, np.zeros(d), dtype)
