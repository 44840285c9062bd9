"""Black-box deep Lagrangian network (Lutter and Peters 2021, "Combining physics and deep learning to learn
continuous-time dynamics models", section on black-box models).

One network is the Lagrangian, with no structure in it:

    L = network([features(q), qd / rate_scale])

Its mass matrix d²L/dqd² is symmetric and nothing more: `metrics.definiteness` reports where it is indefinite.
"""

import functools

import haiku as hk
import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.models.delan import viscous_dissipation
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, Parameters
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import InputError, Needs, Scalar, Vector, require_positive

Scale = float | tuple[float, ...]
"""Typical size of a quantity, in its unit: one number, or one for each coordinate."""


def make_black_box_lagrangian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of a black-box Lagrangian network.

    Args:
        needs: what the scene needs; decides features and friction. One network is the whole Lagrangian, so that
            absent gravity leaves nothing out.
        width: hidden units per layer.
        depth: hidden layers.
        activation: of the hidden layers; it must be smooth, and have curvature in qd, since M is its second derivative.
        rate_scale: typical size of qd, which enters the network divided by it.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth or scale that is not positive, or scales that are not one per coordinate.
    """
    networks = energy_networks(
        needs, "lagrangian", width=width, depth=depth, activation=activation, scale={"rate_scale": rate_scale}
    )
    q = jnp.zeros(needs.degrees_of_freedom, dtype)

    def energies(parameters: Parameters) -> LagrangianSystem:
        energy, dissipation = networks.apply
        return LagrangianSystem(
            functools.partial(energy, parameters), dissipation and functools.partial(dissipation, parameters)
        )

    return Model(init=lambda key: networks.init(key, q, q), energies=energies)


def energy_networks(
    needs: Needs, name: str, *, width: int, depth: int, activation: Activation, scale: dict[str, Scale]
) -> hk.MultiTransformed:
    """Init, and apply of network([features(q), x / scale]) -> scalar and of the dissipation (`None` where absent).

    `scale` is one item: the caller's name for it, and the typical size of x.
    """
    require_positive(width=width, depth=depth)
    ((scale_name, size),) = scale.items()
    sizes = per_coordinate(needs, scale_name, size)

    def energy(q: Vector, x: Vector) -> Scalar:
        layers = hk.nets.MLP([width] * depth + [1], activation=activation.value, name=name)
        return layers(jnp.concatenate([joint_features(needs, q), x / jnp.asarray(sizes, x.dtype)]))[0]

    def build():
        def initialise(q: Vector, x: Vector) -> None:
            energy(q, x)
            if needs.friction:
                viscous_dissipation(q, x)

        return initialise, (energy, viscous_dissipation if needs.friction else None)

    return hk.without_apply_rng(hk.multi_transform(build))


def per_coordinate(needs: Needs, name: str, scale: Scale) -> tuple[float, ...]:
    """One positive size for each coordinate; InputError otherwise."""
    d = needs.degrees_of_freedom
    sizes = tuple(scale) if isinstance(scale, tuple) else (scale,) * d
    if len(sizes) != d:
        raise InputError(f"{name} has {len(sizes)} sizes; expected one number, or one for each of {d} coordinates")
    for size in sizes:
        require_positive(**{name: size})
    return sizes
