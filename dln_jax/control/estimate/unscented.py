"""The unscented Kalman filter: the process is evaluated at points of the belief, without derivatives.

With N = n + k columns s_j of a square root of the covariance of (x, w), the 2 N points mean +- √N s_j have the weight
1 / (2 N) each (Julier and Uhlmann 1997 with kappa = 0; Arasaratnam and Haykin 2009, "Cubature Kalman filters").
Weights are positive, so a triangular factor of the scaled differences is a square root of the covariance. The filter is
exact for a linear process, and to second order for others.
"""

import math

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.control.estimate.process import Belief, Filter, Innovation, Process, corrected, triangular


def unscented(process: Process) -> Filter:
    """Returns the unscented Kalman filter of a process; its memory is a `Belief`."""

    def predict(belief: Belief, u: Array) -> Belief:
        deviation = process.deviation(belief.x, u)
        n, k = len(belief.x), len(deviation)
        reach = math.sqrt(n + k)
        of_x = jnp.concatenate([reach * belief.W.T, jnp.zeros((k, n), belief.W.dtype)])
        of_w = jnp.concatenate([jnp.zeros((n, k), belief.W.dtype), reach * jnp.diag(deviation)])
        signs = jnp.concatenate([of_x, -of_x]), jnp.concatenate([of_w, -of_w])
        points = jax.vmap(lambda dx, w: process.step(belief.x + dx, u, w))(*signs)
        mean = jnp.mean(points, axis=0)
        return Belief(mean, triangular((points - mean).T / math.sqrt(2 * (n + k))))

    def update(belief: Belief, y: Array, seen: Array) -> tuple[Belief, Innovation]:
        n = len(belief.x)
        reach = math.sqrt(n)
        offsets = reach * belief.W.T
        above, below = (jax.vmap(process.measured)(belief.x + sign * offsets) for sign in (1.0, -1.0))
        mean = jnp.mean((above + below) / 2, axis=0)
        slopes = (above - below).T / (2 * reach)
        # Curvature of the measurement counts as noise: the part of its variance that no slope explains.
        bent = jnp.mean(((above + below) / 2 - mean) ** 2, axis=0)
        noise = jnp.broadcast_to(jnp.asarray(process.noise, belief.x.dtype), y.shape)
        return corrected(belief, y, seen, mean, slopes, noise**2 + bent)

    return Filter(process, lambda belief: belief, predict, update)
