"""Random parameters of any model, none of which is where it starts."""

import jax
import jax.numpy as jnp
import numpy as np


def drawn(model, seed=8, size=0.6):
    """Returns normal parameters of the right shapes and types, without compiling anything."""
    random = np.random.default_rng(seed)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    return jax.tree.map(lambda leaf: jnp.asarray(random.normal(size=leaf.shape, scale=size), leaf.dtype), shapes)
