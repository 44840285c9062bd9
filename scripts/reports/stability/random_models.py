"""Untrained models and random states for them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters


def random_parameters(model: Model) -> Parameters:
    """Random parameters of unit gain, without compiling the model's initialisation."""
    random = np.random.default_rng(0)

    def draw(like: jax.ShapeDtypeStruct):
        gain = like.shape[0] ** -0.5 if len(like.shape) > 1 else 0.1
        return jnp.asarray(gain * random.normal(size=like.shape), like.dtype)

    return jax.tree.map(draw, jax.eval_shape(model.init, jax.random.key(0)))


def untrained(model: Model):
    """The dynamics of an untrained model."""
    return dynamics(model.energies(random_parameters(model)))


def random_states(samples: int, d: int, sizes: tuple[float, ...], dtype: Any = np.float64) -> list[np.ndarray]:
    """q, qd and qdd (or tau), as many as there are sizes, of absolute values up to these."""
    random = np.random.default_rng(0)
    return [(random.uniform(-1, 1, (samples, d)) * size).astype(dtype) for size in sizes]
