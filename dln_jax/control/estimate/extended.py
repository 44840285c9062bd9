"""The extended Kalman filter: the process is linearised at the estimate, by forward-mode derivatives.

    x' = step(x, u, 0),   P' = F P Fᵀ + G diag(disturbance²) Gᵀ,   F = d step/dx,  G = d step/dw

The filter carries a square root of P (see `process.corrected`). For a linear process it is the Kalman filter.
"""

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.control.estimate.process import Belief, Filter, Innovation, Process, corrected, triangular


def extended(process: Process) -> Filter:
    """Returns the extended Kalman filter of a process; its memory is a `Belief`."""

    def predict(belief: Belief, u: Array) -> Belief:
        deviation = process.deviation(belief.x, u)
        none = jnp.zeros_like(deviation)
        F, G = jax.jacfwd(process.step, argnums=(0, 2))(belief.x, u, none)
        root = triangular(jnp.concatenate([F @ belief.W, G * deviation], axis=1))
        return Belief(process.step(belief.x, u, none), root)

    def update(belief: Belief, y: Array, seen: Array) -> tuple[Belief, Innovation]:
        H = jax.jacfwd(process.measured)(belief.x)
        noise = jnp.broadcast_to(jnp.asarray(process.noise, belief.x.dtype), y.shape)
        return corrected(belief, y, seen, process.measured(belief.x), H @ belief.W, noise**2)

    return Filter(process, lambda belief: belief, predict, update)
