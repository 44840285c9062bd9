"""Models that nothing has trained."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.models.model import Model, Parameters


def random_parameters(model: Model) -> Parameters:
    """Parameters of a network that nothing has trained, of unit gain: drawn without compiling its initialisation."""
    random = np.random.default_rng(0)

    def draw(like: jax.ShapeDtypeStruct):
        gain = like.shape[0] ** -0.5 if len(like.shape) > 1 else 0.1
        return jnp.asarray(gain * random.normal(size=like.shape), like.dtype)

    return jax.tree.map(draw, jax.eval_shape(model.init, jax.random.key(0)))
