"""Black-box deep Lagrangian network (Lutter and Peters 2021, "Combining physics and deep learning to learn
continuous-time dynamics models", section on black-box models).

One network is the Lagrangian, with no structure in it:

    L = network([features(q), qd / rate_scale])

Its mass matrix d²L/dqd² is symmetric and nothing more: `metrics.definiteness` reports where it is indefinite.
"""

from collections.abc import Callable
from functools import partial

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.models.delan import viscous_dissipation
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, model_of
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
    """The (init, apply) pair of a black-box Lagrangian network; one network, so that absent gravity leaves nothing out.

    The activation needs curvature in qd, since M is the second derivative.

    Args:
        rate_scale: typical size of qd, which enters the network divided by it.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(width=width, depth=depth)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    terms = partial(one_network, needs, "lagrangian", width, depth, activation, rates)
    return model_of(LagrangianSystem, terms, np.zeros(needs.degrees_of_freedom), dtype)


def one_network(
    needs: Needs, name: str, width: int, depth: int, activation: Activation, sizes: tuple[float, ...]
) -> dict[str, Callable[[Vector, Vector], Scalar] | None]:
    """By `name`, the energy network([features(q), x / sizes]) -> scalar; and the dissipation."""

    def energy(q: Vector, x: Vector) -> Scalar:
        layers = hk.nets.MLP([width] * depth + [1], activation=activation.value, name=name)
        return layers(jnp.concatenate([joint_features(needs, q), x / jnp.asarray(sizes, x.dtype)]))[0]

    return {name: energy, "dissipation": viscous_dissipation if needs.friction else None}


def per_coordinate(needs: Needs, name: str, scale: Scale) -> tuple[float, ...]:
    """One positive size for each coordinate; InputError otherwise."""
    d = needs.degrees_of_freedom
    sizes = tuple(scale) if isinstance(scale, tuple) else (scale,) * d
    if len(sizes) != d:
        raise InputError(f"{name} has {len(sizes)} sizes; expected one number, or one for each of {d} coordinates")
    for size in sizes:
        require_positive(**{name: size})
    return sizes
