"""Separable Hamiltonian network (as in Chen et al. 2020, "Symplectic recurrent neural networks"): two networks.

    H = T(p / momentum_scale) + V(features(q))

No product of q and p can be learned, so that explicit symplectic steps (`mechanics.integrators.stormer_verlet`) apply
to it. It fits systems with a constant mass matrix, whatever the kinetic energy.
"""

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.delan import viscous_dissipation
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, model_of
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Needs, Scalar, Vector, require_positive


def make_separable_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    momentum_scale: Scale = 1.0,
    iterations: int = 8,
    initial_guess: Guess | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of T(p) + V(q).

    Without gravity there is no V. Momenta and activation are as for `make_black_box_hamiltonian`.

    Args:
        momentum_scale: typical size of p, which enters the network divided by it.
        iterations: Newton steps to p(qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> p [d] where they start; zero by default.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(width=width, depth=depth, iterations=iterations)
    sizes = per_coordinate(needs, "momentum_scale", momentum_scale)

    def network(name: str, inputs) -> Scalar:
        return hk.nets.MLP([width] * depth + [1], activation=activation.value, name=name)(inputs)[0]

    def kinetic(p: Vector) -> Scalar:
        return network("kinetic", p / jnp.asarray(sizes, p.dtype))

    def potential(q: Vector) -> Scalar:
        return network("potential", joint_features(needs, q))

    def energies(kinetic, potential=None, dissipation=None) -> HamiltonianSystem:
        def total(q: Vector, p: Vector) -> Scalar:
            return kinetic(p) if potential is None else kinetic(p) + potential(q)

        return HamiltonianSystem(total, dissipation, iterations, initial_guess)

    terms = {
        "kinetic": kinetic,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }
    return model_of(energies, lambda: terms, np.zeros(needs.degrees_of_freedom), dtype)
