"""Derivatives of a model's forces by its parameters, at one state."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import Vector


def linearised(
    model: Model, parameters: Parameters, q: Vector, qd: Vector, qdd: Vector
) -> tuple[Float[Array, "d P"], Vector]:
    """Returns Phi = d tau / d theta of one state, with columns in the order of `ravel_pytree(parameters)`, and tau."""

    def torque(parameters: Parameters) -> Vector:
        return dynamics(model.energies(parameters)).inverse_dynamics(q, qd, qdd)

    # Reverse mode takes d pull-backs; forward mode would take a push-forward for all P parameters.
    tau, pull_back = jax.vjp(torque, parameters)
    (rows,) = jax.vmap(pull_back)(np.eye(tau.shape[0], dtype=tau.dtype))
    return jnp.concatenate([leaf.reshape(tau.shape[0], -1) for leaf in jax.tree.leaves(rows)], axis=1), tau
