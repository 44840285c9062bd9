"""Hamiltonian neural networks, structured and black-box (Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural
Networks"; the structured one as in Lutter and Peters 2021, who let a network give the inverse mass matrix).

    structured:  H = ½ |L(q)ᵀ p|² + V(q),  M⁻¹ = L Lᵀ,  diag L = softplus(x + shift) + floor
    black-box:   H = network([features(q), p / momentum_scale])

`mechanics.equations.flow` turns both into Hamilton's equations, and `dynamics` into those in velocities.
"""

import functools

import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.mechanics.natural_hamiltonian import NaturalHamiltonian
from dln_jax.models.black_box import Scale, energy_networks
from dln_jax.models.delan import structured_networks
from dln_jax.models.model import Model, Parameters
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import Needs, require_positive


def make_structured_hamiltonian(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    diagonal_shift: float = 0.0,
    diagonal_floor: float = 0.1,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """The (init, apply) pair of a structured Hamiltonian network.

    Args:
        needs: what the scene needs; decides features and terms.
        width: hidden units per layer, of both networks.
        depth: hidden layers, of both networks.
        activation: of the hidden layers; it must be smooth.
        diagonal_shift: added to the pre-activation of L's diagonal; where the diagonal starts.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M⁻¹.
        dtype: of the parameters.

    Raises:
        InputError: a width or depth that is not positive.
    """
    require_positive(width=width, depth=depth)
    networks = structured_networks(needs, width, depth, activation, diagonal_shift, diagonal_floor)
    q = jnp.zeros(needs.degrees_of_freedom, dtype)

    def energies(parameters: Parameters) -> NaturalHamiltonian:
        factor, potential, dissipation = networks.apply
        return NaturalHamiltonian(
            inverse_factor=functools.partial(factor, parameters),
            potential=potential and functools.partial(potential, parameters),
            dissipation=dissipation and functools.partial(dissipation, parameters),
        )

    return Model(init=lambda key: networks.init(key, q, q), energies=energies)


def make_black_box_hamiltonian(
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
    """The (init, apply) pair of a black-box Hamiltonian network.

    Hamilton's equations need no momentum solve and hold for any parameters. The functions of (q, qd) need one, which
    an untrained network may not have.

    Args:
        needs: what the scene needs; decides features and friction. One network is the whole Hamiltonian, so that
            absent gravity leaves nothing out.
        width: hidden units per layer.
        depth: hidden layers.
        activation: of the hidden layers; it must be smooth, and have curvature in p, since M⁻¹ is that curvature.
        momentum_scale: typical size of p, which enters the network divided by it.
        iterations: Newton steps to p(q, qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> p [d] where they start; zero by default.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth, scale or iterations not positive, or scales that are not one per coordinate.
    """
    require_positive(iterations=iterations)
    networks = energy_networks(
        needs, "hamiltonian", width=width, depth=depth, activation=activation, scale={"momentum_scale": momentum_scale}
    )
    q = jnp.zeros(needs.degrees_of_freedom, dtype)

    def energies(parameters: Parameters) -> HamiltonianSystem:
        energy, dissipation = networks.apply
        return HamiltonianSystem(
            functools.partial(energy, parameters),
            dissipation and functools.partial(dissipation, parameters),
            iterations,
            initial_guess,
        )

    return Model(init=lambda key: networks.init(key, q, q), energies=energies)
