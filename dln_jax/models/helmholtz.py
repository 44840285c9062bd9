"""Helmholtz decomposition of a field in phase space: a part that conserves an energy, and a gradient.

    (qd, pd) = J grad H + grad F,   J grad H = (dH/dp, -dH/dq),   grad F = (dF/dq, dF/dp)

The solenoidal part J grad H has no divergence, the conservative part grad F no rotation. H and F are networks.
F can represent friction without a Rayleigh function of (q, qd): that of a damped spring is F = -½ c p². Fields of
harmonic functions have neither divergence nor rotation and may be in either part. Published with Hamiltonian networks
(Greydanus, Dzamba and Yosinski 2019), with the same canonical J and the same names.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from dln_jax.mechanics.dynamics import PhaseRates
from dln_jax.models.model import Model, model_of
from dln_jax.models.networks import Scale, joint_features, per_coordinate, perceptron
from dln_jax.nn.activations import Activation, tanh
from dln_jax.types import InputError, Needs, Scalar, Vector, require_positive

FIELDS = ("solenoidal", "conservative", "both")


def make_helmholtz(
    needs: Needs,
    *,
    field: str = "both",
    width: int = 64,
    depth: int = 2,
    activation: Activation = tanh,
    momentum_scale: Scale = 1.0,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the (init, energies) pair of a field of rates; H of a solenoidal part is the energy of its flow.

    Args:
        field: parts of the field: "solenoidal" is a Hamiltonian network, "conservative" a gradient, or "both".
        momentum_scale: typical size of p, by which the networks' input is divided.
        needs, width, depth, activation, dtype: as described in `models.model`; friction in the needs has no effect.

    Raises:
        InputError: an unknown field, or numbers that are not positive.
    """
    if field not in FIELDS:
        raise InputError(f"field is {field!r}; expected one of {', '.join(FIELDS)}")
    require_positive(width=width, depth=depth)
    momenta = per_coordinate(needs, "momentum_scale", momentum_scale)

    def scalar(name: str, q: Vector, p: Vector) -> Scalar:
        inputs = jnp.concatenate([joint_features(needs, q), p / jnp.asarray(momenta, p.dtype)])
        return perceptron(name, width, depth, 1, activation)(inputs)[0]

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
    return model_of(record, lambda: terms, needs.degrees_of_freedom, dtype)
