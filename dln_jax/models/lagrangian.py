"""Deep Lagrangian networks, structured and black-box.

    structured:  L = ½ qdᵀ M(q) qd - V(q),  M = L(q) L(q)ᵀ,  diag L = softplus(x + shift) + floor
    black-box:   L = network([features(q), qd / rate_scale])

The structured model (Lutter, Ritter and Peters 2019, "Deep Lagrangian Networks") has a network for the Cholesky factor
of the mass matrix and another for the potential. Terms that the scene lacks are not built: no potential network without
gravity, no dissipation without friction, no cos and sin for prismatic joints.

The black-box model (Lutter and Peters 2021, "Combining physics and deep learning to learn continuous-time dynamics
models", section on black-box models) has no structure. Its mass matrix d²L/dqd² is symmetric but may be indefinite:
`metrics.definiteness` reports where it is.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.model import (
    Model,
    Scale,
    inputs_of,
    joint_features,
    model_of,
    per_coordinate,
    perceptrons,
    viscous_dissipation,
)
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Matrix, Needs, Scalar, Vector

Networks = Callable[[str, int], hk.nets.MLP]
"""(name, outputs) -> network, from `perceptrons`."""


def make_delan(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    diagonal_shift: float = 2.0,
    diagonal_floor: float = 0.1,
    shared_trunk: bool = False,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a structured DeLaN.

    Args:
        diagonal_shift: added to the pre-activation of L's diagonal; sets the initial diagonal.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M; keeps M regular.
        shared_trunk: whether factor and potential are outputs of one network instead of two.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    networks = perceptrons(width, depth, activation)
    terms = partial(
        structured_terms, needs, networks, "cholesky", diagonal_shift, diagonal_floor, shared_trunk=shared_trunk
    )
    return model_of(NaturalSystem, terms, needs.degrees_of_freedom, dtype)


def make_black_box_lagrangian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a black-box Lagrangian: one network, so leaving out gravity saves nothing.

    The activation needs curvature in qd, since M is the second derivative by qd.

    Args:
        rate_scale: typical size of qd; the network's input is divided by it.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    terms = partial(black_box_terms, needs, perceptrons(width, depth, activation), "lagrangian", rates)
    return model_of(LagrangianSystem, terms, needs.degrees_of_freedom, dtype)


def cholesky_factor(entries: Float[Array, "entries"], d: int, *, shift: float, floor: float) -> Matrix:
    """Returns lower triangular L [d, d]: diagonal softplus(entries[:d] + shift) + floor, the other entries below."""
    diagonal = jax.nn.softplus(entries[:d] + shift) + floor
    return jnp.diag(diagonal).at[np.tril_indices(d, -1)].set(entries[d:])


def structured_terms(
    needs: Needs, networks: Networks, factor: str, shift: float, floor: float, *, shared_trunk: bool = False
) -> dict[str, Callable[..., Any] | None]:
    """Returns L(q) under the name `factor`, and the potential and dissipation."""
    d = needs.degrees_of_freedom
    entries = d * (d + 1) // 2
    shared = shared_trunk and needs.gravity
    first = networks("energies", entries + 1) if shared else networks("cholesky", entries)
    second = first if shared else networks("potential", 1)

    def cholesky(q: Vector) -> Matrix:
        return cholesky_factor(first(joint_features(needs, q))[:entries], d, shift=shift, floor=floor)

    def potential(q: Vector) -> Scalar:
        return second(joint_features(needs, q))[-1]

    return {
        factor: cholesky,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }


def black_box_terms(
    needs: Needs, networks: Networks, name: str, sizes: tuple[float, ...]
) -> dict[str, Callable[[Vector, Vector], Scalar] | None]:
    """Returns the energy network([features(q), x / sizes]) -> scalar under `name`, and the dissipation."""

    def energy(q: Vector, x: Vector) -> Scalar:
        return networks(name, 1)(inputs_of(needs, q, (x, sizes)))[0]

    return {name: energy, "dissipation": viscous_dissipation if needs.friction else None}
