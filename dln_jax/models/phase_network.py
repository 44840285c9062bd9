"""A network for the rates of a phase space, which knows no physics: the baseline that Greydanus, Dzamba and Yosinski
(2019) compare with.

    (qd, pd) = rate_scale network([features(q), p / momentum_scale])
"""

import functools

import haiku as hk
import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.plain import PhaseRates
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.features import joint_features, unsaturated
from dln_jax.models.model import Model
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
    """The (init, apply) pair of the baseline.

    Args:
        needs: what the scene needs; decides features. Forces are not told apart.
        width: hidden units per layer.
        depth: hidden layers.
        activation: of the hidden layers.
        momentum_scale: typical size of p.
        rate_scale: typical size of qd and pd.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth or scale that is not positive, or scales that are not one per coordinate.
    """
    require_positive(width=width, depth=depth)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    d = needs.degrees_of_freedom

    @hk.without_apply_rng
    @hk.transform
    def network(q: Vector, p: Vector):
        inputs = jnp.concatenate([joint_features(needs, q), unsaturated(p / jnp.asarray(momenta, p.dtype))])
        layers = hk.nets.MLP([width] * depth + [2 * d], activation=activation.value, name="rates")
        outputs = layers(inputs) * jnp.asarray(rates * 2, p.dtype)
        return outputs[:d], outputs[d:]

    start = jnp.zeros(d, dtype)
    return Model(
        init=lambda key: network.init(key, start, start),
        energies=lambda parameters: PhaseRates(functools.partial(network.apply, parameters)),
    )
