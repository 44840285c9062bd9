"""Baselines without physics: networks for inverse and forward dynamics, or for the rates of a phase space.

    tau = tau_scale network([features(q), qd / rate_scale, qdd / acceleration_scale])
    qdd = acceleration_scale network([features(q), qd / rate_scale, tau / tau_scale])
    (qd, pd) = rate_scale network([features(q), p / momentum_scale])

The first two are separate networks, so one need not invert the other. The last is the baseline of Greydanus, Dzamba and
Yosinski (2019). There is no energy, no mass matrix and no decomposition of forces, so an absent force saves nothing.
"""

from functools import partial

import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.dynamics import InverseForward, PhaseRates
from dln_jax.models.model import Model, model_of
from dln_jax.models.networks import Scale, joint_features, per_coordinate, perceptron, unsaturated
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.sizes import require_network
from dln_jax.types import Needs, Vector


def make_feed_forward(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    rate_scale: Scale = 1.0,
    acceleration_scale: Scale = 1.0,
    tau_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of the networks for tau and qdd.

    Args:
        rate_scale: typical size of qd.
        acceleration_scale: typical size of qdd.
        tau_scale: typical size of tau.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    accelerations = per_coordinate(needs, "acceleration_scale", acceleration_scale)
    forces = per_coordinate(needs, "tau_scale", tau_scale)

    def network(name: str, sizes: tuple[float, ...], output: tuple[float, ...], q: Vector, qd: Vector, x: Vector):
        inputs = jnp.concatenate([joint_features(needs, q), _scaled(qd, rates), _scaled(x, sizes)])
        return jnp.asarray(output, qd.dtype) * perceptron(name, width, depth, len(output), activation)(inputs)

    terms = {
        "inverse_dynamics": partial(network, "inverse", accelerations, forces),
        "forward_dynamics": partial(network, "forward", forces, accelerations),
    }
    return model_of(InverseForward, lambda: terms, needs.degrees_of_freedom, dtype)


def make_phase_network(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of the network for the rates.

    Args:
        momentum_scale: typical size of p.
        rate_scale: typical size of qd and pd.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    d = needs.degrees_of_freedom

    def network(q: Vector, p: Vector):
        inputs = jnp.concatenate([joint_features(needs, q), _scaled(p, momenta)])
        outputs = perceptron("rates", width, depth, 2 * d, activation)(inputs) * jnp.asarray(rates * 2, p.dtype)
        return outputs[:d], outputs[d:]

    return model_of(PhaseRates, lambda: {"rates": network}, d, dtype)


def _scaled(x: Vector, sizes: tuple[float, ...]) -> Array:
    return unsaturated(x / jnp.asarray(sizes, x.dtype))
