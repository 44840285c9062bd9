"""What a controller answers where its state is no number: none."""

from typing import Any

import jax.numpy as jnp
from jax import Array


def where_finite(u: Array, *state: Any) -> Array:
    """The controls [m] of a finite state; of any other, NaN in every motor, for whoever holds the brake.

    A law of some coordinates alone would answer with numbers where others are none, and limits make a number of what is
    infinite.
    """
    finite = jnp.asarray(True)
    for each in state:
        finite &= jnp.isfinite(jnp.asarray(each)).all()
    return jnp.where(finite, u, jnp.nan)
