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
    shared_trunk: bool = False,
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
        shared_trunk: whether factor and potential are outputs of one network instead of two.
        dtype: of the parameters.
    """
    networks = structured_networks(
        needs, width, depth, activation, diagonal_shift, diagonal_floor, shared_trunk=shared_trunk
    )
    q = jnp.zeros(needs.degrees_of_freedom, dtype)

    def energies(parameters: Parameters) -> NaturalSystem:
        cholesky, potential, dissipation = networks.apply
        return NaturalSystem(
            cholesky=functools.partial(cholesky, parameters),
            potential=potential and functools.partial(potential, parameters),
            dissipation=dissipation and functools.partial(dissipation, parameters),
        )

    return Model(init=lambda key: networks.init(key, q, q), energies=energies)


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
) -> hk.MultiTransformed:
    """Init of all networks, and apply of each: triangular factor, potential, dissipation (`None` where absent)."""
    d = needs.degrees_of_freedom

    def network(name: str, outputs: int, q: Vector):
        layers = hk.nets.MLP([width] * depth + [outputs], activation=activation.value, name=name)
        return layers(joint_features(needs, q))

    entries = d * (d + 1) // 2
    shared = shared_trunk and needs.gravity

    def cholesky(q: Vector) -> Matrix:
        outputs = network("energies", entries + 1, q)[:-1] if shared else network("cholesky", entries, q)
        return cholesky_factor(outputs, d, shift=shift, floor=floor)

    def potential(q: Vector) -> Scalar:
        return network("energies", entries + 1, q)[-1] if shared else network("potential", 1, q)[0]

    def build():
        def initialise(q: Vector, qd: Vector) -> None:
            cholesky(q)
            if needs.gravity and not shared:
                potential(q)
            if needs.friction:
                viscous_dissipation(q, qd)

        return initialise, (
            cholesky,
            potential if needs.gravity else None,
            viscous_dissipation if needs.friction else None,
        )

    return hk.without_apply_rng(hk.multi_transform(build))
