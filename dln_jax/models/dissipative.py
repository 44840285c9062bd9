"""Hamiltonian models with dissipation.

D = ½ sum_j c_j(q) qd_j²,   c = softplus(network(features(q))) > 0,   dH/dt = -2 D <= 0
"""

import haiku as hk
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.equations import Canonical
from dln_jax.models.model import Model, Parameters
from dln_jax.models.networks import joint_features, perceptron
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.sizes import require_network
from dln_jax.types import Needs, Scalar, Vector, require_positive


def make_dissipative(
    model: Model,
    needs: Needs,
    *,
    width: int = 8,
    depth: int = 1,
    activation: Activation | str = tanh,
    initial_friction: float = 0.05,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Adds friction that depends on q to a Hamiltonian `Model`, so that it loses energy for any parameters.

    Args:
        model: conservative, built for needs without friction.
        needs: of the scene; without friction nothing is added.
        initial_friction: approximate initial value of c, in N m s or N s/m.
        width, depth, activation, dtype: of the network for c, as described in `models.model`.

    Raises:
        InputError: a width, depth or friction that is not positive.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    require_positive(initial_friction=initial_friction)
    if not needs.friction:
        return model
    d = needs.degrees_of_freedom
    shift = jnp.log(jnp.expm1(jnp.asarray(initial_friction, dtype)))

    @hk.without_apply_rng
    @hk.transform
    def coefficients(q: Vector) -> Vector:
        layers = perceptron("friction", width, depth, d, activation)
        return jax.nn.softplus(layers(joint_features(needs, q)) + shift)

    def init(key: Array) -> Parameters:
        first, second = jax.random.split(key)
        return {"energy": model.init(first), "friction": coefficients.init(second, jnp.zeros(d, dtype))}

    def energies(parameters: Parameters) -> Canonical:
        def dissipation(q: Vector, qd: Vector) -> Scalar:
            return 0.5 * jnp.sum(coefficients.apply(parameters["friction"], q) * qd**2)

        return model.energies(parameters["energy"])._replace(dissipation=dissipation)

    return Model(init, energies)
