"""Roots of small systems of equations by Newton's method, differentiable by the implicit function theorem.

    f(x, theta) = 0,    x <- x - J⁻¹ f,    J = df/dx        (Newton)
    dx = -J⁻¹ (df/dtheta) dtheta                            (implicit function theorem)

The derivative does not run through the iterations. It costs one linear solve, in forward and in reverse mode and to any
order, and is as accurate as the root.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, require_positive

Root = Float[Array, " n"]

# A root that is correct to the last digit has a residual of about eps |J| |x|; evaluating f adds a few times this.
_ROUNDING_UNITS = 16


class SolverInfo(NamedTuple):
    """Outcome of a search for a root or a minimum."""

    residual: Float[Array, ""]
    """Largest |f| at the last point: of the equations, or of the gradient in units of its scale."""
    iterations: Int[Array, ""]
    """Newton steps taken."""
    converged: Bool[Array, ""]
    """Whether the residual is within the tolerance or at the level of rounding; false if values are not finite."""
    definite: Bool[Array, ""] | None = None
    """Whether the Hessian at a minimum is positive definite (no saddle); `None` unless requested."""
    energy_noise: Float[Array, ""] | None = None
    """Energy changes below this are lost in rounding at a minimum, in the unit of the energy; `None` for a root."""
    overflow: Bool[Array, ""] | None = None
    """Whether a list of moving elements was too short at a minimum; `None` without moving elements."""
    lists: tuple[Any, Any] = ((), ())
    """Moving elements at the start and at the minimum."""


def find_root(
    function: Callable[..., Array], start: Root, *arguments: Any, tolerance: float = 0.0, iterations: int = 30
) -> tuple[Root, SolverInfo]:
    """Returns x [n] with function(x, *arguments) = 0, for up to about twenty equations and a start near the root.

    There is no line search, so the iteration may diverge from a distant start. `SolverInfo.converged` reports that; x
    is then the last iterate. The root can be differentiated by the arguments and by arrays that the function closes
    over, not by the start.

    Args:
        function: (x [n], *arguments) -> f [n].
        start: first iterate [n].
        arguments: pytrees passed to the function.
        tolerance: largest |f_i| that counts as zero, in the unit of f; rounding, 16 eps |J| |x|, always does. One more
            step improves the accepted point and roughly squares its error.
        iterations: largest number of Newton steps.

    Raises:
        InputError: a negative tolerance, no iterations, or a start that is not a vector.
    """
    require_positive(iterations=iterations)
    if not tolerance >= 0:
        raise InputError(f"tolerance is {tolerance}; expected a number >= 0 (0 for the accuracy of rounding)")

    def search(function: Callable[[Root], Root], start: Root) -> tuple[Root, tuple[Array, Array, Array]]:
        real = start.dtype
        rounding = _ROUNDING_UNITS * jnp.finfo(real).eps

        def twice(x: Root) -> tuple[Root, Root]:
            value = function(x)
            return value, value

        def iterate(state: tuple[Array, ...]) -> tuple[Array, ...]:
            # One evaluation per turn both tests and improves the point, so the function is compiled once.
            x, _, count, *_ = state
            jacobian, value = jax.jacfwd(twice, has_aux=True)(x)
            step = solve(jacobian, value)
            residual = jnp.max(jnp.abs(value))
            floor = rounding * jnp.max(jnp.abs(jacobian) @ jnp.abs(x))
            converged = residual <= jnp.maximum(tolerance, floor)
            running = ~converged & jnp.isfinite(residual) & (count + 1 < iterations)
            return jnp.where(jnp.isfinite(step).all(), x - step, x), residual, count + 1, converged, running

        first = start, jnp.asarray(jnp.inf, real), jnp.asarray(0), jnp.asarray(False), jnp.asarray(True)
        x, residual, count, converged, _ = jax.lax.while_loop(lambda state: state[-1], iterate, first)
        # `custom_root` accepts only real numbers as auxiliary output.
        return x, (residual, count.astype(real), converged.astype(real))

    def solve_linearised(product: Callable[[Root], Root], right: Root) -> Root:
        return solve(jax.jacfwd(product)(right), right)

    root, (residual, count, converged) = jax.lax.custom_root(
        lambda x: function(x, *arguments), start, search, solve_linearised, has_aux=True
    )
    return root, SolverInfo(residual, count.astype(int), converged > 0)
