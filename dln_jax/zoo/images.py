"""Latent models of images: an autoencoder of their principal components, and dynamics in the latent plane."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.arguments import vectors
from dln_jax.models.latent_phase import (
    Components,
    Field,
    LatentModel,
    LatentPhase,
    latent_field,
    make_latent_phase,
    through_components,
)
from dln_jax.nn.activations import Activation, silu, tanh
from dln_jax.types import InputError, require_positive

MOST_NUMBERS = 10**8
"""Largest number of entries in the basis of principal components."""


class ImageModel(NamedTuple):
    """A parametric model of images and their latent plane."""

    init: Callable[[Array], Any]
    """Random key -> {"parameters": of the networks, "components": mean, basis and scale of the components}."""
    images: Callable[[Any], LatentPhase]
    """Parameters -> functions of two successive images [2 n]."""
    of_coefficients: Callable[[float], LatentModel]
    """Typical coefficient -> the model of the components' coefficients, which is the one trained."""


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
        momentum_scale: typical latent momentum, for a typical coordinate of 1.

    Raises:
        InputError: an unknown field, a size that is not positive, or components of more than `MOST_NUMBERS` entries.
    """
    require_positive(pixels=pixels, components=components)
    if pixels * components > MOST_NUMBERS:
        raise InputError(f"{components} components of {pixels} pixels are more than {MOST_NUMBERS:,} numbers")
    size: dict[str, Any] = {"width": field_width, "depth": field_depth, "activation": field_activation}
    moving = latent_field(field, **size, momentum_scale=momentum_scale, dtype=dtype)

    def of_coefficients(scale: float) -> LatentModel:
        return make_latent_phase(moving, components, scale=scale, width=width, activation=activation, dtype=dtype)

    unit = of_coefficients(1.0)

    def init(key: Array) -> Any:
        shapes = {"mean": (pixels,), "basis": (components, pixels), "scale": ()}
        arrays = {name: jnp.ones(shape, dtype) for name, shape in shapes.items()}
        return {"parameters": unit.init(key), "components": arrays}

    def images(parameters: Any) -> LatentPhase:
        stored = parameters["components"]
        scale = stored["scale"]

        def scaled(parameters: Any) -> LatentPhase:
            inner = unit.apply(parameters)
            return LatentPhase(
                lambda c: inner.encode(c / scale.astype(c.dtype)),
                lambda q, p: inner.decode(q, p) * scale.astype(q.dtype),
                inner.field,
            )

        basis = Components(stored["mean"], stored["basis"], 1.0, 0.0)
        system = through_components(LatentModel(unit.init, scaled, moving), basis).apply(parameters["parameters"])
        return LatentPhase(
            lambda frames: system.encode(*vectors(2 * pixels, frames=frames)),
            lambda q, p: system.decode(*vectors(1, q=q, p=p)),
            system.field,
        )

    return ImageModel(init, images, of_coefficients)


def with_components(components: Components, parameters: Any, dtype: DTypeLike = jnp.float32) -> Any:
    """The parameters of an `ImageModel`, from those of the model of its coefficients."""
    arrays = {"mean": components.mean, "basis": components.basis, "scale": components.scale}
    return {"parameters": parameters, "components": {name: jnp.asarray(array, dtype) for name, array in arrays.items()}}
