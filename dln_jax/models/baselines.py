"""Networks for inverse and forward dynamics, for the rates of a phase space, and for functions of x.

    tau = tau_scale network([features(q), qd / rate_scale, qdd / acceleration_scale])
    qdd = acceleration_scale network([features(q), qd / rate_scale, tau / tau_scale])
    (qd, pd) = rate_scale network([features(q), p / momentum_scale])
    (qd, pd) = J grad H + grad F,   J grad H = (dH/dp, -dH/dq),   grad F = (dF/dq, dF/dp)

The first two are separate networks, so one need not invert the other. The third is the baseline of Greydanus, Dzamba
and Yosinski (2019). These three have no energy, mass matrix or force decomposition, and leaving out gravity or friction
saves nothing.

The last one is a Helmholtz decomposition from the same paper, with its canonical J and its names. The solenoidal part J
grad H has no divergence and conserves H; the conservative part grad F has no rotation. H and F are networks of
[features(q), p / momentum_scale]. F can represent friction without a Rayleigh function of (q, qd): for a damped spring
it is F = -½ c p². A field without divergence and rotation can be in either part.

A differential network, or an ensemble of them, is a function of x with its Jacobian and Hessian.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.errors import require_network
from dln_jax.mechanics.arguments import vectors
from dln_jax.mechanics.dynamics import InverseForward, PhaseRates
from dln_jax.models.model import Model, Scale, inputs_of, model_of, per_coordinate, perceptrons, unsaturated
from dln_jax.nn.activations import Activation, tanh
from dln_jax.nn.differential_mlp import Layers, init_ensemble, layer_shapes, value_jacobian_and_hessian
from dln_jax.types import InputError, Needs, Scalar, Vector, VectorLike, require_positive

FIELDS = ("solenoidal", "conservative", "both")


def make_feed_forward(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    rate_scale: Scale = 1.0,
    acceleration_scale: Scale = 1.0,
    tau_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of the networks for tau and qdd.

    Args:
        rate_scale: typical size of qd.
        acceleration_scale: typical size of qdd.
        tau_scale: typical size of tau.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    networks = perceptrons(width, depth, activation)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    accelerations = per_coordinate(needs, "acceleration_scale", acceleration_scale)
    forces = per_coordinate(needs, "tau_scale", tau_scale)

    def network(name: str, sizes: tuple[float, ...], output: tuple[float, ...], q: Vector, qd: Vector, x: Vector):
        inputs = inputs_of(needs, q, (unsaturated(qd), rates), (unsaturated(x), sizes))
        return jnp.asarray(output, qd.dtype) * networks(name, len(output))(inputs)

    terms = {
        "inverse_dynamics": partial(network, "inverse", accelerations, forces),
        "forward_dynamics": partial(network, "forward", forces, accelerations),
    }
    return model_of(InverseForward, lambda: terms, needs, dtype)


def make_phase_network(
    needs: Needs,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    rate_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of the network for the rates.

    Args:
        momentum_scale: typical size of p.
        rate_scale: typical size of qd and pd.
        needs, width, depth, activation, dtype: as described in `models.model`.
    """
    networks = perceptrons(width, depth, activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)
    rates = per_coordinate(needs, "rate_scale", rate_scale)
    d = needs.degrees_of_freedom

    def network(q: Vector, p: Vector):
        outputs = networks("rates", 2 * d)(inputs_of(needs, q, (unsaturated(p), momenta))) * jnp.asarray(
            rates * 2, p.dtype
        )
        return outputs[:d], outputs[d:]

    return model_of(PhaseRates, lambda: {"rates": network}, needs, dtype)


def make_helmholtz(
    needs: Needs,
    *,
    field: str = "both",
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a field of rates; H of the solenoidal part is the energy of its flow.

    Args:
        field: parts of the field: "solenoidal" is a Hamiltonian network, "conservative" a gradient, or "both".
        momentum_scale: typical size of p; the networks' input is divided by it.
        needs, width, depth, activation, dtype: as described in `models.model`; friction in the needs has no effect.

    Raises:
        InputError: the field is unknown, or a number is not positive.
    """
    if field not in FIELDS:
        raise InputError(f"field is {field!r}; expected one of {', '.join(FIELDS)}")
    networks = perceptrons(width, depth, activation)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)

    def scalar(name: str, q: Vector, p: Vector) -> Scalar:
        return networks(name, 1)(inputs_of(needs, q, (p, momenta)))[0]

    def record(hamiltonian=None, potential=None) -> PhaseRates:
        def rates(q: Vector, p: Vector) -> tuple[Vector, Vector]:
            qd, pd = jnp.zeros_like(q), jnp.zeros_like(p)
            if hamiltonian is not None:
                force, velocity = jax.grad(hamiltonian, argnums=(0, 1))(q, p)
                qd, pd = velocity, -force
            if potential is not None:
                along_q, along_p = jax.grad(potential, argnums=(0, 1))(q, p)
                qd, pd = qd + along_q, pd + along_p
            return qd, pd

        return PhaseRates(rates, hamiltonian)

    terms = {
        "hamiltonian": None if field == "conservative" else partial(scalar, "hamiltonian"),
        "potential": None if field == "solenoidal" else partial(scalar, "potential"),
    }
    return model_of(record, lambda: terms, needs, dtype)


class Derivatives(NamedTuple):
    """Derivatives at one x [n]; for an ensemble, means over its members."""

    value: Float[Array, "m"]
    jacobian: Float[Array, "m n"]
    hessian: Float[Array, "m n n"]


class FunctionModel(NamedTuple):
    """A parametric function of x."""

    init: Callable[[Array], Layers]
    """Random key -> layers, with ensemble members on the leading axis, even for one member."""
    derivatives: Callable[[Layers], Callable[[VectorLike], Derivatives]]
    """Layers -> function of x [n] that checks its argument."""


def make_differential_network(
    *, sizes: tuple[int, ...], activation: Activation, members: int, dtype: DTypeLike = jnp.float32
) -> FunctionModel:
    """Returns an ensemble of the networks in `nn.differential_mlp`.

    Args:
        sizes: (inputs n, hidden widths ..., outputs m).
        members: number of networks in the ensemble.

    Raises:
        InputError: invalid sizes, too large a network, or no members.
    """
    require_positive(members=members)
    layer_shapes(sizes)
    require_network(width=max(sizes), depth=max(len(sizes) - 2, 1))

    def derivatives(layers: Layers) -> Callable[[VectorLike], Derivatives]:
        def function(x):
            (inputs,) = vectors(sizes[0], x=x)
            every = jax.vmap(lambda member: value_jacobian_and_hessian(member, inputs, activation=activation))(layers)
            return Derivatives(*(array.mean(axis=0) for array in every))

        return function

    return FunctionModel(lambda key: init_ensemble(key, sizes, members=members, dtype=dtype), derivatives)
