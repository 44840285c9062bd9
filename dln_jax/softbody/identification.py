"""Identifies material, friction, actuation or shape of a soft body from observations, by Levenberg-Marquardt.

    minimise over theta:  mean over motions of |x(t; theta) - x_observed(t)|² / noise²        (identification)
    minimise over theta:  |x*(theta) - x_wanted|² / noise²,   x* an equilibrium               (inverse design)

Derivatives go through the implicit steps, or through the equilibrium. theta is any tree of float64 arrays;
`params_of(theta)` maps it to `Params`, for example by `exp` if a parameter must stay positive.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optimistix
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.precision import quick_compilation
from dln_jax.rollout import rollout
from dln_jax.scale import local, program, spread
from dln_jax.softbody.scene import Params, SoftScene
from dln_jax.softbody.step import Stepper, static_solve
from dln_jax.types import require_positive


class ObservedMotions(NamedTuple):
    """K observed motions of one body, with T steps."""

    x0: Float[Array, "K n dim"]
    """Positions at the start, in m."""
    v0: Float[Array, "K n dim"]
    """Velocities at the start, in m/s."""
    controls: Any
    """Actuation of the steps: an array [K, T, controls] ([K, T, 0] without actuation), or a dict of arrays [K, T, ...]
    by the names of the actuated terms."""
    x: Float[Array, "K T n dim"]
    """Positions after every step, in m; not finite for unobserved vertices."""


class SoftBodyFit(NamedTuple):
    """Result of an identification or a design."""

    parameters: Any
    """theta."""
    misfit: float
    """Root mean square of the final residuals, in units of the noise; NaN if a step did not converge."""
    iterations: int


def identify(
    stepper: Stepper,
    params_of: Callable[[Any], Params],
    guess: Any,
    motions: ObservedMotions,
    *,
    noise: float = 1e-3,
    iterations: int = 30,
    mesh: Mesh | None = None,
) -> SoftBodyFit:
    """Fits theta to bring the simulated motions closest to the observed motions.

    Args:
        stepper: result of `make_step`.
        params_of: theta -> the scene's parameters.
        guess: initial theta, float64 arrays.
        noise: standard deviation of the positions, in m; it divides the residuals.
        iterations: largest number of Levenberg-Marquardt iterations.
        mesh: devices that share the motions; every device simulates its own.

    Raises:
        InputError: a number is not positive.
    """
    require_positive(noise=noise, iterations=iterations)
    init, step = stepper

    def residual(theta: Any, x0: Array, v0: Array, controls: Any, observed: Array) -> Array:
        driven = any(leaf.size for leaf in jax.tree.leaves(controls))
        advance, inputs = functools.partial(step, params_of(theta)), controls if driven else None
        _, x = rollout(advance, init(x0, v0), inputs, steps=observed.shape[0], observe=lambda state, info: state.x)
        return _seen_difference(x, observed) / noise

    residuals = spread(lambda theta, motions: jax.vmap(functools.partial(residual, theta))(*motions), mesh)
    return _fitted(lambda theta: residuals(theta, motions), guess, iterations, mesh)


def design(
    scene: SoftScene,
    params_of: Callable[[Any], Params],
    guess: Any,
    wanted: Float[Array, "n dim"],
    *,
    noise: float = 1e-3,
    iterations: int = 30,
) -> SoftBodyFit:
    """Finds theta (for example a rest shape) with the equilibrium closest to the wanted positions.

    Held vertices stay at their places in the scene's rest shape. Non-finite coordinates of `wanted` are ignored. Other
    arguments and errors are as for `identify`.
    """
    require_positive(noise=noise, iterations=iterations)

    def residual(theta: Any) -> Array:
        return _seen_difference(static_solve(scene, params_of(theta), x=scene.params.rest)[0], wanted) / noise

    return _fitted(residual, guess, iterations)


def _seen_difference(x: Array, observed: Array) -> Array:
    """Returns the difference of positions: zero, with finite derivatives, for non-finite observations."""
    seen = jnp.isfinite(observed)
    return jnp.where(seen, x - jnp.where(seen, observed, 0), 0)


def _fitted(residual: Callable[[Any], Array], guess: Any, iterations: int, mesh: Mesh | None = None) -> SoftBodyFit:
    solver = optimistix.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    # Forward mode: there are few parameters and thousands of residuals.
    settings = {"options": {"jac": "fwd"}, "max_steps": iterations, "throw": False}

    def solve(guess: Any) -> tuple[Any, Array, Array]:
        solution = optimistix.least_squares(lambda theta, _: residual(theta), solver, guess, **settings)
        misfit = jnp.sqrt(jnp.mean(residual(solution.value) ** 2))
        return solution.value, misfit, solution.stats["num_steps"]

    theta, misfit, count = program(solve, mesh, compiler_options=quick_compilation())(guess)
    return SoftBodyFit(local(theta, mesh), float(misfit), int(count))
