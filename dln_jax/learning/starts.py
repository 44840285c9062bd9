"""Eliminates the unknowns of one window, such as the start of its motion, from a residual with other parameters.

    z(theta) = argmin over z of |r(theta, z)|²,   dr/dtheta = (1 - U Uᵀ) dr/dtheta at fixed z,   U a basis of dr/dz

This is the derivative of Kaufman (1975, "A variable projection method for solving separable nonlinear least squares
problems"), which omits a term that is small if the residual is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.solvers.elimination import solve

STEPS = 3
"""Gauss-Newton steps from the measured to the nearest start."""


def without_start(frozen: Callable[[Array], Array], residual: Callable[[Array], Array], start: Array) -> Array:
    """Returns the residual at its nearest start, with Kaufman's derivative by parameters that `frozen` holds constant.

    Args:
        frozen: start -> residual, with constant parameters.
        residual: the same function, differentiable by the parameters.
        start: initial value.
    """
    at = jax.lax.stop_gradient(_descended(frozen, start, STEPS))
    left = residual(at.start)
    change = left - jax.lax.stop_gradient(left)  # zero, with the derivative of `left`
    return left - at.slope @ solve(at.slope.T @ at.slope, at.slope.T @ change)


def nearest(residual: Callable[[Array], Array], start: Array, *, steps: int = STEPS) -> Array:
    """Returns a start of lower residual, by steps of Gauss-Newton."""
    return _descended(residual, start, steps).start


class _Descended(NamedTuple):
    start: Array
    slope: Array
    """Derivative of the residual by the start, at the beginning of the last step."""


def _descended(residual: Callable[[Array], Array], start: Array, steps: int) -> _Descended:
    linearised = jax.jacfwd(lambda start: (residual(start),) * 2, has_aux=True)

    def step(at: _Descended, _: Any) -> tuple[_Descended, None]:
        slope, value = linearised(at.start)
        return _Descended(at.start - solve(slope.T @ slope, slope.T @ value), slope), None

    nothing = jnp.zeros((jax.eval_shape(residual, start).shape[0], start.shape[0]), start.dtype)
    return jax.lax.scan(step, _Descended(start, nothing), length=steps)[0]
