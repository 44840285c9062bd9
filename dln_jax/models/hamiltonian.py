"""Hamiltonian neural networks, structured and black-box (Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural
Networks"; the structured one as in Lutter and Peters 2021, who let a network give the inverse mass matrix).

    structured:  H = ½ |L(q)ᵀ p|² + V(q),  M⁻¹ = L Lᵀ,  diag L = softplus(x + shift) + floor
    black-box:   H = network([features(q), p / momentum_scale])

`mechanics.equations.flow` turns both into Hamilton's equations, and `dynamics` into those in velocities.
"""

from functools import partial

import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.mechanics.natural_hamiltonian import NaturalHamiltonian
from dln_jax.models.black_box import Scale, one_network, per_coordinate
from dln_jax.models.delan import structured_networks
from dln_jax.models.model import Model, model_of
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
        diagonal_shift: added to the pre-activation of L's diagonal; where the diagonal starts.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M⁻¹.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(width=width, depth=depth)
    terms = partial(
        structured_networks, needs, width, depth, activation, diagonal_shift, diagonal_floor, factor="inverse_factor"
    )
    return model_of(NaturalHamiltonian, terms, np.zeros(needs.degrees_of_freedom), dtype)


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
    an untrained network may not have, and an activation with curvature in p, since M⁻¹ is that curvature. Absent
    gravity leaves nothing out.

    Args:
        momentum_scale: typical size of p, which enters the network divided by it.
        iterations: Newton steps to p(q, qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> p [d] where they start; zero by default.
        needs, width, depth, activation, dtype: as for all, in `models.model`.
    """
    require_positive(iterations=iterations, width=width, depth=depth)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    terms = partial(one_network, needs, "hamiltonian", width, depth, activation, momenta)
    record = partial(HamiltonianSystem, iterations=iterations, initial_guess=initial_guess)
    return model_of(record, terms, np.zeros(needs.degrees_of_freedom), dtype)
