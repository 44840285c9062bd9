"""Phase-space models behind an autoencoder, which learn coordinates from images (Greydanus, Dzamba and Yosinski 2019,
"Hamiltonian Neural Networks", section on pixels).

    z_q = encoder(x_1),  z_p = encoder(x_2) - z_q,     x_1_hat = decoder(z_q),  x_2_hat = decoder(z_q + z_p)
    d(z_q, z_p) / d frame = rates(z_q, z_p)

x_1, x_2 [n] are consecutive frames; the second one determines the velocity. For any parameters the momentum is the
change of the coordinate per frame; the published autoencoder, (z_q, z_p) = encoder(x_1, x_2), has to learn this. Both
networks have four layers, the hidden ones residual:

    h = g(W_1 x + b_1),   h <- h + g(W_k h + b_k) for k = 2, 3,   output = W_4 h + b_4

The rates come from an energy of one coordinate, or from a network: any `Model`. The unit of latent time is a frame. The
networks see numbers divided by their typical size. Images enter as their principal components: fewer numbers with the
same distances, up to the lost variance,

    c = B (x - mean),   x_hat = mean + Bᵀ c,   rows of B [C, n]: the eigenvectors of the covariance, largest first
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike
from jaxtyping import Float

from dln_jax.errors import require_network
from dln_jax.mechanics.arguments import vectors
from dln_jax.mechanics.dynamics import Flow, PhaseRates
from dln_jax.mechanics.equations import flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.models.baselines import make_phase_network
from dln_jax.models.hamiltonian import make_black_box_hamiltonian
from dln_jax.models.model import Model
from dln_jax.nn.activations import Activation, silu, tanh
from dln_jax.types import InputError, Needs, require_positive

NEEDS = Needs(joints=("prismatic",))
"""Needs of the latent plane: z_q is a number, not an angle, without applied forces or friction."""
LAYERS = 4
MOST_NUMBERS = 10**8
"""Largest number of entries in the basis of principal components."""
Field = Literal["black-box-hnn", "phase-network"]
"""Kind of latent dynamics: from an energy, or from a network for the rates."""

Latent = Float[Array, "1"]


class LatentPhase(NamedTuple):
    """Autoencoder and dynamics of the latent plane, as functions of one sample; use `vmap` for batches."""

    encode: Callable[[Array], tuple[Array, Array]]
    """Two frames [2 n] -> (z_q, z_p), both [1]."""
    decode: Callable[[Array, Array], Array]
    """(z_q, z_p) -> two frames [2 n]."""
    field: Flow | PhaseRates
    """(z_q, z_p) -> rates per frame; with an energy for black-box-hnn."""


class ImageModel(NamedTuple):
    """A parametric model of images and their latent plane."""

    init: Callable[[Array], Any]
    """Random key -> {"parameters": of the networks "encoder", "decoder" and "field", "components": of the images, with
    their "mean" [n], "basis" [C, n] and the "scale" of a coefficient}."""
    images: Callable[[Any], LatentPhase]
    """Parameters -> functions of two successive images [2 n]."""
    coefficients: Callable[[Any, float | Array], LatentPhase]
    """(parameters of the networks, scale) -> functions of the images' coefficients [2 C], for training."""
    field: Model
    """Model of the latent dynamics; its parameters are those of the network "field"."""


def make_image_model(
    *,
    field: Field,
    pixels: int,
    components: int,
    field_width: int = 64,
    field_depth: int = 2,
    field_activation: Activation = tanh,
    width: int = 200,
    activation: Activation = silu,
    momentum_scale: float = 0.2,
    dtype: DTypeLike = jnp.float32,
) -> ImageModel:
    """Makes a model of images that encodes each frame by its principal components.

    Args:
        field: kind of dynamics in the latent plane.
        field_width: hidden units per layer of the latent dynamics.
        field_depth: hidden layers of the latent dynamics.
        width: hidden units per layer of encoder and decoder.
        momentum_scale: typical size of z_p relative to that of z_q: 0.2 for motions of 30 frames per period.

    Raises:
        InputError: a size that is not positive, or components of more than `MOST_NUMBERS` entries.
    """
    require_positive(pixels=pixels, components=components)
    if pixels * components > MOST_NUMBERS:
        raise InputError(f"{components} components of {pixels} pixels are more than {MOST_NUMBERS:,} numbers")
    require_network(width=width, depth=2)
    size: dict[str, Any] = {"width": field_width, "depth": field_depth, "activation": field_activation}
    # Explicit values: a change of the defaults must not change stored models.
    size |= {"momentum_scale": 1.0, "dtype": dtype}
    has_energy = field == "black-box-hnn"
    unit = (
        make_black_box_hamiltonian(NEEDS, **size) if has_energy else make_phase_network(NEEDS, **size, rate_scale=1.0)
    )

    # States and rates of the unit model are of order 1; its motions take 1 / rate frames per unit of its time. With
    # P = p / rate: (q, p)' = (rate Q'(q, P), rate² P'(q, P)), and for an energy H0(q, P), H = rate² H0.
    def slowed(parameters: Any) -> HamiltonianSystem | PhaseRates:
        system, rate = unit.energies(parameters), momentum_scale
        if has_energy:
            return HamiltonianSystem(lambda q, p: rate**2 * system.hamiltonian(q, p / rate))

        def rates(q: Latent, p: Latent) -> tuple[Latent, Latent]:
            qd, pd = system.rates(q, p / rate)
            return rate * qd, rate**2 * pd

        return PhaseRates(rates)

    dynamics = Model(unit.init, slowed)
    encoder = _residual_network("encoder", width, 1, activation)
    decoder = _residual_network("decoder", width, components, activation)

    def init(key: Array) -> Any:
        first, second, third = jax.random.split(key, 3)
        networks = {
            "encoder": encoder.init(first, jnp.zeros((2, components), dtype)),
            "decoder": decoder.init(second, jnp.zeros((2, 1), dtype)),
            "field": dynamics.init(third),
        }
        shapes = {"mean": (pixels,), "basis": (components, pixels), "scale": ()}
        return {
            "parameters": networks,
            "components": {name: jnp.ones(shape, dtype) for name, shape in shapes.items()},
        }

    def coefficients(networks: Any, scale: float | Array) -> LatentPhase:
        def encode(c: Float[Array, " two_C"]) -> tuple[Latent, Latent]:
            z = encoder.apply(networks["encoder"], c.reshape(2, components) / scale)
            return z[0], z[1] - z[0]

        def decode(q: Latent, p: Latent) -> Float[Array, " two_C"]:
            return (scale * decoder.apply(networks["decoder"], jnp.stack([q, q + p]))).ravel()

        return LatentPhase(encode, decode, flow(dynamics.energies(networks["field"]), degrees_of_freedom=1))

    def images(parameters: Any) -> LatentPhase:
        mean, basis, scale = (parameters["components"][name] for name in ("mean", "basis", "scale"))
        inner = coefficients(parameters["parameters"], scale)

        def encode(frames: Float[Array, " two_n"]) -> tuple[Latent, Latent]:
            (pair,) = vectors(2 * pixels, frames=frames)
            return inner.encode(((pair.reshape(2, pixels) - mean) @ basis.T).ravel())

        def decode(q: Latent, p: Latent) -> Float[Array, " two_n"]:
            q, p = vectors(1, q=q, p=p)
            return (mean + inner.decode(q, p).reshape(2, components) @ basis).ravel()

        return LatentPhase(encode, decode, inner.field)

    return ImageModel(init, images, coefficients, dynamics)


def _residual_network(name: str, width: int, outputs: int, activation: Activation) -> hk.Transformed:
    def network(x: Float[Array, "rows inputs"]) -> Float[Array, "rows outputs"]:
        h = activation.value(hk.Linear(width, name=f"{name}_1")(x))
        for layer in range(2, LAYERS):
            h = h + activation.value(hk.Linear(width, name=f"{name}_{layer}")(h))
        return hk.Linear(outputs, name=f"{name}_{LAYERS}")(h)

    return hk.without_apply_rng(hk.transform(network))
