"""A rigid tree, and small networks for the torque that the tree does not explain.

    V = Σ_j s_j v_j(q),   D = Σ_j s_j r_j d_j(q, qd),   L = diag(√(s / a)) (lower triangle)(q)

v, d and L are outputs of networks; s_j, r_j and a_j are typical sizes of the unexplained torque, the rates and the
accelerations. The networks start with small outputs, so training starts at the tree.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from dln_jax.errors import require_network
from dln_jax.mechanics.residual import Residual, with_residual
from dln_jax.models.model import Model, Parameters, Scale, joint_features, model_of, per_coordinate
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.types import InputError, Matrix, Needs, ResidualTerm, Scalar, Vector

TERMS: tuple[ResidualTerm, ...] = get_args(ResidualTerm)
START = 0.1
"""Initial size of the last layer's weights, relative to the usual one."""


class ResidualParameters(NamedTuple):
    """Parameters of a rigid tree and its residual networks."""

    rigid: Any
    residual: Parameters


def make_with_residual(rigid: Model, residual: Model) -> Model:
    """Returns the sum of a `make_rigid_tree` and a `make_residual`."""

    def init(key: Array) -> ResidualParameters:
        return ResidualParameters(rigid.init(key), residual.init(key))

    def energies(parameters: ResidualParameters) -> Any:
        return with_residual(rigid.energies(parameters.rigid), residual.energies(parameters.residual))

    return Model(init, energies)


def make_residual(
    needs: Needs,
    *,
    terms: tuple[ResidualTerm, ...] = ("potential", "dissipation"),
    width: int = 8,
    depth: int = 1,
    activation: Activation | str = tanh,
    resolved_velocity: Scale = 0.05,
    torque_scale: Scale = 1.0,
    rate_scale: Scale = 1.0,
    acceleration_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns the networks alone; `energies` gives a `Residual`.

    Args:
        terms: some of potential, dissipation and inertia.
        resolved_velocity: rate near rest that the dissipation network resolves, 1/s or m/s.
        torque_scale, rate_scale, acceleration_scale: s, r and a above, in their units.
        needs, width, depth, activation, dtype: as described in `models.model`.

    Raises:
        InputError: a term is missing or unknown, or a size is not positive.
    """
    require_network(width=width, depth=depth)
    activation = activation_of(activation)
    if not terms or set(terms) - set(TERMS) or len(set(terms)) < len(terms):
        raise InputError(f"terms are {list(terms)}; expected some of {', '.join(TERMS)}, each once")
    d = needs.degrees_of_freedom
    scales = {"torque_scale": torque_scale, "rate_scale": rate_scale, "acceleration_scale": acceleration_scale}
    s, r, a = (np.array(per_coordinate(needs, name, scale)) for name, scale in scales.items())
    slow = np.array(per_coordinate(needs, "resolved_velocity", resolved_velocity))

    def network(name: str, outputs: int, inputs: Array) -> Array:
        small = hk.initializers.VarianceScaling(START**2)
        hidden = hk.nets.MLP([width] * depth, activation=activation.value, name=name, activate_final=True)
        return hk.Linear(outputs, w_init=small, name=f"{name}_output")(hidden(inputs))

    def potential(q: Vector) -> Scalar:
        return jnp.sum(jnp.asarray(s, q.dtype) * network("potential", d, joint_features(needs, q)))

    def dissipation(q: Vector, qd: Vector) -> Scalar:
        rates = [qd / jnp.asarray(r, qd.dtype), jnp.tanh(qd / jnp.asarray(slow, qd.dtype))]
        outputs = network("dissipation", d, jnp.concatenate([joint_features(needs, q), *rates]))
        return jnp.sum(jnp.asarray(s * r, qd.dtype) * outputs)

    def cholesky(q: Vector) -> Matrix:
        entries = network("inertia", d * (d + 1) // 2, joint_features(needs, q))
        rows = jnp.zeros((d, d), q.dtype).at[np.tril_indices(d)].set(entries)
        return jnp.asarray(np.sqrt(s / a), q.dtype)[:, None] * rows

    every: dict[str, tuple[str, Callable[..., Any]]] = {
        "potential": ("potential", potential),
        "dissipation": ("dissipation", dissipation),
        "inertia": ("cholesky", cholesky),
    }
    return model_of(Residual, lambda: dict(every[term] for term in terms), needs, dtype)


def frozen(model: Model, rigid: Any) -> Model:
    """Fixes the rigid part of a `make_with_residual`: the parameters are those of the residual alone."""
    rigid = jax.tree.map(jnp.asarray, rigid)
    return Model(
        lambda key: model.init(key).residual, lambda parameters: model.energies(ResidualParameters(rigid, parameters))
    )
