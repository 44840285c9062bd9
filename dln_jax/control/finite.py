"""Controls of states that are not finite: NaN."""

from typing import Any

import jax.numpy as jnp
from jax import Array


def where_finite(u: Array, *state: Any) -> Array:
    """Returns the controls [m] for a finite state, and NaN in every motor otherwise, for whoever handles the failure.

    Without it, a law of some coordinates only would return numbers while others are NaN, and limits would turn
    infinities into numbers.
    """
    finite = jnp.asarray(True)
    for each in state:
        finite &= jnp.isfinite(jnp.asarray(each)).all()
    return jnp.where(finite, u, jnp.nan)
