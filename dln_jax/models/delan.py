"""Structured deep Lagrangian network (Lutter, Ritter and Peters 2019, "Deep Lagrangian Networks").

One network gives the Cholesky factor of the mass matrix, another the potential:

    T = ½ qdᵀ M(q) qd,  M = L(q) L(q)ᵀ,  diag L = softplus(x + shift) + floor,  V = V(q)

What the scene lacks is not built: no potential network without gravity, no dissipation without friction, no cos and
sin for prismatic joints.
"""

import functools

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from dln_jax.mechanics import natural
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, Parameters
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
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of a structured DeLaN.

    Args:
        needs: what the scene needs; decides features and terms.
        width: hidden units per layer, of both networks.
        depth: hidden layers, of both networks.
        activation: of the hidden layers; it must be smooth, since forces are second derivatives of the energy.
        diagonal_shift: added to the pre-activation of L's diagonal; where the diagonal starts.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M; bounds M's eigenvalues
            away from zero.
        dtype: of the parameters.
    """
    networks = _networks(needs, width, depth, activation, diagonal_shift, diagonal_floor)
    q = jnp.zeros(needs.degrees_of_freedom, dtype)

    def system(parameters: Parameters) -> NaturalSystem:
        cholesky, potential, dissipation = networks.apply
        return NaturalSystem(
            cholesky=functools.partial(cholesky, parameters),
            potential=potential and functools.partial(potential, parameters),
            dissipation=dissipation and functools.partial(dissipation, parameters),
        )

    return Model(
        init=lambda key: networks.init(key, q, q),
        apply=lambda parameters: natural.dynamics(system(parameters)),
    )


def cholesky_factor(entries: Float[Array, "entries"], d: int, *, shift: float, floor: float) -> Matrix:
    """Lower triangular L [d, d]: diagonal softplus(entries[:d] + shift) + floor, the rest of the entries below it."""
    diagonal = jax.nn.softplus(entries[:d] + shift) + floor
    return jnp.diag(diagonal).at[np.tril_indices(d, -1)].set(entries[d:])


def _networks(
    needs: Needs, width: int, depth: int, activation: Activation, shift: float, floor: float
) -> hk.MultiTransformed:
    """Init of all networks, and apply of each: Cholesky factor, potential, dissipation (`None` where absent)."""
    d = needs.degrees_of_freedom

    def network(name: str, outputs: int, q: Vector):
        layers = hk.nets.MLP([width] * depth + [outputs], activation=activation.value, name=name)
        return layers(joint_features(needs, q))

    def cholesky(q: Vector) -> Matrix:
        return cholesky_factor(network("cholesky", d * (d + 1) // 2, q), d, shift=shift, floor=floor)

    def potential(q: Vector) -> Scalar:
        return network("potential", 1, q)[0]

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        coefficients = hk.get_parameter("viscous_friction", (d,), qd.dtype, hk.initializers.Constant(-3.0))
        return 0.5 * jnp.sum(jax.nn.softplus(coefficients) * qd**2)

    def build():
        def initialise(q: Vector, qd: Vector) -> None:
            cholesky(q)
            if needs.gravity:
                potential(q)
            if needs.friction:
                dissipation(q, qd)

        return initialise, (
            cholesky,
            potential if needs.gravity else None,
            dissipation if needs.friction else None,
        )

    return hk.without_apply_rng(hk.multi_transform(build))
