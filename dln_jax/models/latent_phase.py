"""Phase-space models behind an autoencoder, which learn coordinates from images (Greydanus, Dzamba and Yosinski 2019,
"Hamiltonian Neural Networks", section on pixels).

    z_q = encoder(x_1),  z_p = encoder(x_2) - z_q,     x_1_hat = decoder(z_q),  x_2_hat = decoder(z_q + z_p)
    d(z_q, z_p) / d frame = rates(z_q, z_p)

x_1, x_2 [n / 2] are consecutive frames; the second one determines the velocity. For any parameters the momentum is the
change of the coordinate per frame; the published autoencoder, (z_q, z_p) = encoder(x_1, x_2), has to learn this. Both
networks have four layers, the hidden ones residual:

    h = g(W_1 x + b_1),   h <- h + g(W_k h + b_k) for k = 2, 3,   output = W_4 h + b_4

The rates come from an energy of one coordinate, or from a network: any `Model`. The unit of latent time is a frame. The
networks see numbers divided by their typical size. Images enter as their principal components, which are fewer numbers
with nearly the same distances, up to the lost variance,

    c = B (x - mean),   x_hat = mean + Bᵀ c,   rows of B [C, n]: the eigenvectors of the covariance, largest first
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.mechanics.dynamics import Flow, PhaseRates, PlainFlow
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.models.baselines import make_phase_network
from dln_jax.models.hamiltonian import make_black_box_hamiltonian
from dln_jax.models.model import Model, Parameters
from dln_jax.nn.activations import Activation, silu, tanh
from dln_jax.nn.activations import activation as activation_of
from dln_jax.sizes import require_network
from dln_jax.types import InputError, Needs, require_positive

NEEDS = Needs(joints=("prismatic",))
"""Needs of the latent plane: z_q is a number, not an angle, without applied forces or friction."""
LAYERS = 4
Field = Literal["black-box-hnn", "phase-network"]
"""Dynamics of the latent plane: from an energy, or from a network for the rates."""

Latent = Float[Array, "1"]


class LatentPhase(NamedTuple):
    """Autoencoder and dynamics of the latent plane, as functions of one sample; use `vmap` for batches."""

    encode: Callable[[Array], tuple[Array, Array]]
    """Two frames [n] -> (z_q, z_p), both [1]."""
    decode: Callable[[Array, Array], Array]
    """(z_q, z_p) -> two frames [n]."""
    field: Flow | PlainFlow
    """(z_q, z_p) -> rates per frame; with an energy for black-box-hnn."""


class LatentModel(NamedTuple):
    """Autoencoder and latent dynamics with parameters, as an (init, apply) pair."""

    init: Callable[[Array], Parameters]
    """Random key -> parameters: a dictionary of "encoder", "decoder" and "field"."""
    apply: Callable[[Parameters], LatentPhase]
    """Parameters -> functions."""
    field: Model
    """Model of the latent dynamics; its parameters are `parameters["field"]`."""


def latent_field(
    name: str,
    *,
    width: int = 64,
    depth: int = 2,
    activation: Activation | str = tanh,
    momentum_scale: float = 0.2,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns a model of one coordinate: a black-box energy, or a network for the rates.

    Args:
        name: black-box-hnn or phase-network.
        momentum_scale: typical size of z_p relative to that of z_q: 0.2 for motions of 30 frames per period.
        width, depth, activation, dtype: as described in `models.model`.

    Raises:
        InputError: the name is unknown, or a size is not positive.
    """
    if name not in get_args(Field):
        raise InputError(f"field is '{name}'; expected one of {', '.join(get_args(Field))}")
    size: dict[str, Any] = {"width": width, "depth": depth, "activation": activation, "dtype": dtype}
    # Explicit, so that a change of their defaults does not change stored models.
    size["momentum_scale"] = 1.0
    if name == "black-box-hnn":
        model, slowed = make_black_box_hamiltonian(NEEDS, **size), _slowed_energy
    else:
        model, slowed = make_phase_network(NEEDS, **size, rate_scale=1.0), _slowed_rates
    return Model(model.init, lambda parameters: slowed(model.energies(parameters), momentum_scale))


# States and rates of the models are of order 1; their motions take 1 / rate frames per unit of the models' time. With
# P = p / rate: (q, p)' = (rate Q'(q, P), rate² P'(q, P)), and for an energy H0(q, P), H = rate² H0.


def _slowed_energy(system: HamiltonianSystem, rate: float) -> HamiltonianSystem:
    return HamiltonianSystem(lambda q, p: rate**2 * system.hamiltonian(q, p / rate))


def _slowed_rates(system: PhaseRates, rate: float) -> PhaseRates:
    def rates(q: Latent, p: Latent) -> tuple[Latent, Latent]:
        qd, pd = system.rates(q, p / rate)
        return rate * qd, rate**2 * pd

    return PhaseRates(rates)


def make_latent_phase(
    field: Model,
    count: int,
    *,
    scale: float = 0.2,
    width: int = 200,
    activation: Activation | str = silu,
    dtype: DTypeLike = jnp.float32,
) -> LatentModel:
    """Returns the (init, apply) pair of an autoencoder with a phase model of one coordinate in its latent plane.

    Args:
        field: model of the latent plane, from `latent_field`.
        count: number of values per frame, n / 2; the values have mean zero.
        scale: typical size of the values.
        width: hidden units per layer of both networks.

    Raises:
        InputError: a number is not positive.
    """
    require_positive(count=count, scale=scale)
    require_network(width=width, depth=2)
    activation = activation_of(activation)

    @hk.without_apply_rng
    @hk.transform
    def encoder(x: Float[Array, " n"]) -> tuple[Latent, Latent]:
        z = _residual_network(x.reshape(2, -1) / scale, width, 1, activation, "encoder")
        return z[0], z[1] - z[0]

    @hk.without_apply_rng
    @hk.transform
    def decoder(q: Latent, p: Latent) -> Float[Array, " n"]:
        return (scale * _residual_network(jnp.stack([q, q + p]), width, count, activation, "decoder")).ravel()

    def init(key: Array) -> Parameters:
        first, second, third = jax.random.split(key, 3)
        z = jnp.zeros(1, dtype)
        return {
            "encoder": encoder.init(first, jnp.zeros(2 * count, dtype)),
            "decoder": decoder.init(second, z, z),
            "field": field.init(third),
        }

    def apply(parameters: Parameters) -> LatentPhase:
        return LatentPhase(
            functools.partial(encoder.apply, parameters["encoder"]),
            functools.partial(decoder.apply, parameters["decoder"]),
            flow(field.energies(parameters["field"]), degrees_of_freedom=1),
        )

    return LatentModel(init, apply, field)


class Components(NamedTuple):
    """An orthonormal basis of images."""

    mean: Float[np.ndarray, " n"]
    basis: Float[np.ndarray, "C n"]
    scale: float
    """Root mean square of a coefficient."""
    lost: float
    """Share of the variance outside the basis."""


def principal_components(images: Float[np.ndarray, "*samples n"], count: int) -> Components:
    """Returns the components with the largest variance.

    Raises:
        InputError: the count is outside 1..n.
    """
    n = images.shape[-1]
    if not 1 <= count <= n:
        raise InputError(f"components is {count}; expected 1 to {n}, the number of pixels")
    flat = images.reshape(-1, n).astype(float)
    mean = flat.mean(axis=0)
    variances, vectors = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
    kept = variances[-count:].sum()
    return Components(mean, vectors[:, ::-1][:, :count].T, float(np.sqrt(kept / count)), 1 - kept / variances.sum())


def compress(components: Components, images: Float[np.ndarray, "*samples n"]) -> Float[np.ndarray, "*samples C"]:
    """Returns the coefficients of images, in the dtype of the images."""
    return ((images - components.mean) @ components.basis.T).astype(images.dtype)


def through_components(model: LatentModel, components: Components) -> LatentModel:
    """Turns a model of principal components into a model of images with the same parameters."""

    def apply(parameters: Parameters) -> LatentPhase:
        inner = model.apply(parameters)

        def encode(x: Float[Array, " n"]) -> tuple[Latent, Latent]:
            mean, basis = (jnp.asarray(array, x.dtype) for array in components[:2])
            return inner.encode(((x.reshape(2, -1) - mean) @ basis.T).ravel())

        def decode(q: Latent, p: Latent) -> Float[Array, " n"]:
            mean, basis = (jnp.asarray(array, q.dtype) for array in components[:2])
            return (mean + inner.decode(q, p).reshape(2, -1) @ basis).ravel()

        return LatentPhase(encode, decode, inner.field)

    return LatentModel(model.init, apply, model.field)


def _residual_network(
    x: Float[Array, "rows inputs"], width: int, outputs: int, activation: Activation, name: str
) -> Float[Array, "rows outputs"]:
    h = activation.value(hk.Linear(width, name=f"{name}_1")(x))
    for layer in range(2, LAYERS):
        h = h + activation.value(hk.Linear(width, name=f"{name}_{layer}")(h))
    return hk.Linear(outputs, name=f"{name}_{LAYERS}")(h)
