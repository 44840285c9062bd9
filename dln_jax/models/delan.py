"""Structured deep Lagrangian network (Lutter, Ritter and Peters 2019, "Deep Lagrangian Networks").

One network gives the Cholesky factor of the mass matrix, another the potential:

    T = ½ qdᵀ M(q) qd,  M = L(q) L(q)ᵀ,  diag L = softplus(x + shift) + floor,  V = V(q)

What the scene lacks is not built: no potential network without gravity, no dissipation without friction, no cos and
sin for prismatic joints.
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

from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, model_of
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Matrix, Needs, Scalar, Vector


def make_delan(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    diagonal_shift: float = 2.0,
    diagonal_floor: float = 0.1,
    shared_trunk: bool = False,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of a structured DeLaN.

    Args:
        diagonal_shift: added to the pre-activation of L's diagonal; where the diagonal starts.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M; bounds M's eigenvalues
            away from zero.
        shared_trunk: whether factor and potential are outputs of one network instead of two.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    terms = partial(
        structured_networks, needs, width, depth, activation, diagonal_shift, diagonal_floor, shared_trunk=shared_trunk
    )
    return model_of(NaturalSystem, terms, np.zeros(needs.degrees_of_freedom), dtype)


def cholesky_factor(entries: Float[Array, "entries"], d: int, *, shift: float, floor: float) -> Matrix:
    """Lower triangular L [d, d]: diagonal softplus(entries[:d] + shift) + floor, the rest of the entries below it."""
    diagonal = jax.nn.softplus(entries[:d] + shift) + floor
    return jnp.diag(diagonal).at[np.tril_indices(d, -1)].set(entries[d:])


def viscous_dissipation(q: Vector, qd: Vector) -> Scalar:
    """D = ½ Σ b qd², with one learned coefficient b = softplus(x) > 0 per coordinate; inside a transformed function."""
    coefficients = hk.get_parameter("viscous_friction", qd.shape, qd.dtype, hk.initializers.Constant(-3.0))
    return 0.5 * jnp.sum(jax.nn.softplus(coefficients) * qd**2)


def structured_networks(
    needs: Needs,
    width: int,
    depth: int,
    activation: Activation,
    shift: float,
    floor: float,
    *,
    shared_trunk: bool = False,
    factor: str = "cholesky",
) -> dict[str, Callable[..., Any] | None]:
    """By the name of the factor, L(q); and potential and dissipation."""
    d = needs.degrees_of_freedom
    entries = d * (d + 1) // 2
    shared = shared_trunk and needs.gravity

    def network(name: str, outputs: int):
        layers = hk.nets.MLP([width] * depth + [outputs], activation=activation.value, name=name)
        return lambda q: layers(joint_features(needs, q))

    first = network("energies", entries + 1) if shared else network("cholesky", entries)
    second = first if shared else network("potential", 1)

    def cholesky(q: Vector) -> Matrix:
        return cholesky_factor(first(q)[:entries], d, shift=shift, floor=floor)

    def potential(q: Vector) -> Scalar:
        return second(q)[-1]

    return {
        factor: cholesky,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }
