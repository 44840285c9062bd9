"""Separable Hamiltonian network (as in Chen et al. 2020, "Symplectic recurrent neural networks"): two networks.

    H = T(p / momentum_scale) + V(features(q))

No product of q and p can be learned, so that explicit symplectic steps (`mechanics.integrators.stormer_verlet`) apply
to it. It fits systems with a constant mass matrix, whatever the kinetic energy.
"""

import functools

import haiku as hk
import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.hamiltonian import Guess, HamiltonianSystem
from dln_jax.models.black_box import Scale, per_coordinate
from dln_jax.models.delan import viscous_dissipation
from dln_jax.models.features import joint_features
from dln_jax.models.model import Model, Parameters
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

    Hamilton's equations need no momentum solve and hold for any parameters. The functions of (q, qd) need one, which
    an untrained network may not have.

    Args:
        needs: what the scene needs; decides features, friction, and whether there is a V.
        width: hidden units per layer, of both networks.
        depth: hidden layers, of both networks.
        activation: of the hidden layers; it must be smooth, and have curvature in p, since M⁻¹ is that curvature.
        momentum_scale: typical size of p, which enters the network divided by it.
        iterations: Newton steps to p(qd), as in `mechanics.hamiltonian.conjugate`.
        initial_guess: (q, qd) -> p [d] where they start; zero by default.
        dtype: of the parameters.

    Raises:
        InputError: a width, depth, scale or iterations not positive, or scales that are not one per coordinate.
    """
    require_positive(width=width, depth=depth, iterations=iterations)
    sizes = per_coordinate(needs, "momentum_scale", momentum_scale)

    def network(name: str, inputs) -> Scalar:
        return hk.nets.MLP([width] * depth + [1], activation=activation.value, name=name)(inputs)[0]

    def kinetic(p: Vector) -> Scalar:
        return network("kinetic", p / jnp.asarray(sizes, p.dtype))

    def potential(q: Vector) -> Scalar:
        return network("potential", joint_features(needs, q))

    def build():
        def initialise(q: Vector) -> None:
            kinetic(q)
            if needs.gravity:
                potential(q)
            if needs.friction:
                viscous_dissipation(q, q)

        return initialise, (
            kinetic,
            potential if needs.gravity else None,
            viscous_dissipation if needs.friction else None,
        )

    networks = hk.without_apply_rng(hk.multi_transform(build))

    def energies(parameters: Parameters) -> HamiltonianSystem:
        kinetic, potential, dissipation = networks.apply

        def total(q: Vector, p: Vector) -> Scalar:
            energy = kinetic(parameters, p)
            return energy if potential is None else energy + potential(parameters, q)

        friction = dissipation and functools.partial(dissipation, parameters)
        return HamiltonianSystem(total, friction, iterations, initial_guess)

    return Model(init=lambda key: networks.init(key, jnp.zeros(needs.degrees_of_freedom, dtype)), energies=energies)
