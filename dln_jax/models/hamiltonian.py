"""Hamiltonian neural networks, structured, black-box and separable.

    structured:  H = ½ |L(q)ᵀ p|² + V(q),  M⁻¹ = L Lᵀ,  diag L = softplus(x + shift) + floor
    black-box:   H = network([features(q), p / momentum_scale])
    separable:   H = T(p / momentum_scale) + V(features(q)), with two networks

The black-box model is that of Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks". The structured one
follows Lutter and Peters 2021, whose network gives the inverse mass matrix, and the separable one Chen et al. 2020,
"Symplectic recurrent neural networks". The separable model cannot express products of q and p, so that explicit
symplectic steps (`mechanics.integrators.stormer_verlet`) apply to it. It fits systems with a constant mass matrix and
any kinetic energy of p.

`mechanics.equations.flow` turns all of them into Hamilton's equations, and `dynamics` into equations in velocities.
"""

from functools import partial

import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian
from dln_jax.models.lagrangian import one_network, structured_networks
from dln_jax.models.model import Model, model_of
from dln_jax.models.networks import Scale, joint_features, per_coordinate, perceptron, viscous_dissipation
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.sizes import require_network
from dln_jax.types import Needs, Scalar, Vector, require_positive


def make_structured_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    diagonal_shift: float = 0.0,
    diagonal_floor: float = 0.1,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a structured Hamiltonian network.

    Args:
        diagonal_shift: added to the pre-activation of L's diagonal; it sets the initial diagonal.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M⁻¹.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    terms = partial(
        structured_networks, needs, width, depth, activation, diagonal_shift, diagonal_floor, factor="inverse_factor"
    )
    return model_of(NaturalHamiltonian, terms, needs.degrees_of_freedom, dtype)


def make_black_box_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    iterations: int = 8,
    initial_guess: Guess | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a black-box Hamiltonian network.

    Hamilton's equations need no solution for the momentum and hold for any parameters. Functions of (q, qd) need one,
    which may not exist for an untrained network. They also need an activation with curvature in p, since M⁻¹ is the
    second derivative in p. Absent gravity saves nothing.

    Args:
        momentum_scale: typical size of p, by which the network's input is divided.
        iterations: Newton steps to p(q, qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> initial p [d] of these steps; zero by default.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_network(width=width, depth=depth)
    require_positive(iterations=iterations)
    activation = activation_of(activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    terms = partial(one_network, needs, "hamiltonian", width, depth, activation, momenta)
    record = partial(HamiltonianSystem, iterations=iterations, initial_guess=initial_guess)
    return model_of(record, terms, needs.degrees_of_freedom, dtype)


def make_separable_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    iterations: int = 8,
    initial_guess: Guess | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of T(p) + V(q).

    Without gravity there is no V. Momenta and activation are as for `make_black_box_hamiltonian`.

    Args:
        momentum_scale: typical size of p, by which the network's input is divided.
        iterations: Newton steps to p(qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> initial p [d] of these steps; zero by default.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    require_positive(iterations=iterations)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)

    def kinetic(p: Vector) -> Scalar:
        return perceptron("kinetic", width, depth, 1, activation)(p / jnp.asarray(momenta, p.dtype))[0]

    def potential(q: Vector) -> Scalar:
        return perceptron("potential", width, depth, 1, activation)(joint_features(needs, q))[0]

    def energies(kinetic, potential=None, dissipation=None) -> HamiltonianSystem:
        def total(q: Vector, p: Vector) -> Scalar:
            return kinetic(p) if potential is None else kinetic(p) + potential(q)

        return HamiltonianSystem(total, dissipation, iterations, initial_guess)

    terms = {
        "kinetic": kinetic,
        "potential": potential if needs.gravity else None,
        "dissipation": viscous_dissipation if needs.friction else None,
    }
    return model_of(energies, lambda: terms, needs.degrees_of_freedom, dtype)
