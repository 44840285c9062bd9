"""Hamiltonian neural networks, structured, black-box and separable, and their dissipation.

    structured:   H = ½ |L(q)ᵀ p|² + V(q),  M⁻¹ = L Lᵀ,  diag L = softplus(x + shift) + floor
    black-box:    H = network([features(q), p / momentum_scale])
    separable:    H = T(p / momentum_scale) + V(features(q)), with two networks
    dissipative:  D = ½ sum_j c_j(q) qd_j²,   c = softplus(network(features(q))) > 0,   dH/dt = -2 D <= 0

The black-box model is that of Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks". The structured one
follows Lutter and Peters 2021, with a network for the inverse mass matrix, and the separable one Chen et al. 2020,
"Symplectic recurrent neural networks". The separable model cannot express products of q and p, so explicit symplectic
steps (`mechanics.integrators.stormer_verlet`) apply to it. It fits systems whose kinetic energy depends on p alone.

`mechanics.equations.flow` turns all of them into Hamilton's equations, and `dynamics` into equations in velocities.
"""

from collections.abc import Callable
from functools import partial

import haiku as hk
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.equations import Canonical
from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian
from dln_jax.models.model import (
    Model,
    Parameters,
    Scale,
    black_box_terms,
    joint_features,
    model_of,
    per_coordinate,
    perceptrons,
    structured_terms,
    viscous_dissipation,
)
from dln_jax.nn.activations import Activation, tanh
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
        diagonal_shift: added to the pre-activation of L's diagonal; sets the initial diagonal.
        diagonal_floor: smallest diagonal element of L, in the square root of the unit of M⁻¹.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    networks = perceptrons(width, depth, activation)
    terms = partial(structured_terms, needs, networks, "inverse_factor", diagonal_shift, diagonal_floor)
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

    Hamilton's equations hold for any parameters and need no solve for the momentum. Functions of (q, qd) do, and for an
    untrained network it may have no solution. They also need an activation with curvature in p, since M⁻¹ is the second
    derivative by p. Leaving out gravity saves nothing.

    Args:
        momentum_scale: typical size of p; the network's input is divided by it.
        iterations: Newton steps to p(q, qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> initial p [d] of these steps; zero by default.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    require_positive(iterations=iterations)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    terms = partial(black_box_terms, needs, perceptrons(width, depth, activation), "hamiltonian", momenta)
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
    """Returns the (init, energies) pair of T(p) + V(q), without V if there is no gravity.

    Arguments and requirements on the activation are as for `make_black_box_hamiltonian`; `initial_guess` returns p(qd).
    """
    require_positive(iterations=iterations)
    networks = perceptrons(width, depth, activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)

    def kinetic(p: Vector) -> Scalar:
        return networks("kinetic", 1)(p / jnp.asarray(momenta, p.dtype))[0]

    def potential(q: Vector) -> Scalar:
        return networks("potential", 1)(joint_features(needs, q))[0]

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


def make_dissipative(
    make: Callable[[Needs], Model],
    needs: Needs,
    *,
    friction_width: int = 0,
    friction_depth: int = 1,
    friction_activation: Activation | str = tanh,
    initial_friction: float = 0.05,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Adds friction that may depend on q to a Hamiltonian `Model`, so that it loses energy for any parameters.

    Args:
        make: needs -> the model.
        needs: needs of the scene; without friction the keywords have no effect.
        friction_width: hidden units of the network for c; 0 keeps the constant coefficients, as in `make`.
        initial_friction: approximate initial value of c, in N m s or N s/m.
        friction_depth, friction_activation, dtype: keywords of the network, as described in `models.model`.

    Raises:
        InputError: a width, depth or friction is not positive.
    """
    if not (needs.friction and friction_width):
        return make(needs)
    require_network(width=friction_width, depth=friction_depth)
    require_positive(initial_friction=initial_friction)
    networks = perceptrons(friction_width, friction_depth, friction_activation)
    model, d = make(needs._replace(friction=False)), needs.degrees_of_freedom
    shift = jnp.log(jnp.expm1(jnp.asarray(initial_friction, dtype)))

    @hk.without_apply_rng
    @hk.transform
    def coefficients(q: Vector) -> Vector:
        return jax.nn.softplus(networks("friction", d)(joint_features(needs, q)) + shift)

    def init(key: Array) -> Parameters:
        first, second = jax.random.split(key)
        return {"energy": model.init(first), "friction": coefficients.init(second, jnp.zeros(d, dtype))}

    def energies(parameters: Parameters) -> Canonical:
        def dissipation(q: Vector, qd: Vector) -> Scalar:
            return 0.5 * jnp.sum(coefficients.apply(parameters["friction"], q) * qd**2)

        return model.energies(parameters["energy"])._replace(dissipation=dissipation)

    return Model(init, energies)
