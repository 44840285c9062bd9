"""Dynamics in discrete time for controllers, and motions under recorded torques.

A step for controllers is x_next = F(x, u, dt), with A = dF/dx and B = dF/du:

    x = (q, qd) [2 d],   qdd = forward_dynamics(q, qd, tau),   tau = actuation u, held over the step
    x = (q, p) [2 d] in a phase space, without u

A step takes a fixed number of operations: the implicit midpoint rule here takes a fixed number of Newton steps, whereas
`mechanics.integrators` iterates until convergence. Derivatives are exact (for the implicit step by the implicit
function theorem at the last iterate) and share the Jacobians of `mechanics.jacobians`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.mechanics import integrators
from dln_jax.mechanics.dynamics import Rates
from dln_jax.mechanics.integrators import Method, State, advance, from_start
from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, require_positive

ITERATIONS = 3
"""Number of Newton steps of the implicit midpoint rule."""
Step = Callable[[Any, Any, Any], Any]
"""(x, u, dt) -> x_next."""
PhaseStep = Callable[[Any, Any, Any], Any]
"""(q, p, dt) -> (q, p) after the step."""
Torque = Literal["held", "interpolated"]
"""Assumption about a recorded torque between its samples."""
Actuation = Sequence[Sequence[float]] | Float[np.ndarray, "d u"] | None
"""Actuation matrix of `types.Needs`; with `None`, u is tau."""


def rk4(forward_dynamics: Callable[..., Array], *, actuation: Actuation = None) -> Step:
    """Returns the classical Runge-Kutta step of order 4 for (q, qd, tau) -> qdd."""

    def step(x: Array, u: Array, dt: Array) -> Array:
        tau = _force(actuation, u)
        field = integrators.second_order(lambda t, q, qd: forward_dynamics(q, qd, tau))
        return jnp.concatenate(integrators.rk4(field)(0.0, tuple(jnp.split(x, 2)), dt))

    return step


def implicit_midpoint(
    forward_dynamics: Callable[..., Array], *, actuation: Actuation = None, iterations: int = ITERATIONS
) -> Step:
    """Returns a step of the implicit midpoint rule, of order 2, with Newton's method for qdd at the midpoint.

        qdd = forward_dynamics(q + dt/2 v, v, tau),   v = qd + dt/2 qdd;   (q, qd) <- (q + dt v, qd + dt qdd)

    Args:
        forward_dynamics: (q, qd, tau) -> qdd; use `jacobians.differentiable_forward_dynamics` if you differentiate the
            step.
        actuation: matrix [d, u] with tau = actuation u.
        iterations: Newton steps, from the acceleration at x. If the last one still moves the state by more than
            sqrt(eps) (1 + |x|), the step is NaN: take a smaller dt. The error is about the square of the last move.

    Raises:
        InputError: `iterations` is not positive.
    """
    require_positive(iterations=iterations)

    def step(x: Array, u: Array, dt: Array) -> Array:
        q, qd = jnp.split(x, 2)
        tau = _force(actuation, u)

        def equations(qdd: Array) -> Array:
            velocity = qd + dt / 2 * qdd
            return qdd - forward_dynamics(q + dt / 2 * velocity, velocity, tau)

        qdd = _root(equations, forward_dynamics(q, qd, tau), x, dt, iterations)
        return jnp.concatenate([q + dt * (qd + dt / 2 * qdd), qd + dt * qdd])

    return step


def phase_rk4(rates: Rates) -> PhaseStep:
    """Returns the step of `rk4` for (q, p) -> (qd, pd)."""
    return lambda q, p, dt: integrators.rk4(lambda t, state: rates(*state))(0.0, (q, p), dt)


def phase_implicit_midpoint(rates: Rates, *, iterations: int = ITERATIONS) -> PhaseStep:
    """Returns the step of `implicit_midpoint` for (q, p) -> (qd, pd); symplectic for the rates of a Hamiltonian."""
    require_positive(iterations=iterations)

    def field(x: Array) -> Array:
        return jnp.concatenate(rates(*jnp.split(x, 2)))

    def step(q: Array, p: Array, dt: Array) -> tuple[Array, Array]:
        x = jnp.concatenate([q, p])
        rate = _root(lambda rate: rate - field(x + dt / 2 * rate), field(x), x, dt, iterations)
        q_next, p_next = jnp.split(x + dt * rate, 2)
        return q_next, p_next

    return step


def linearised(step: Callable[[Any, Any, Any], Any]) -> Callable[[Array, Array, Array], tuple[Any, Any]]:
    """Returns (x, u, dt) -> x_next and (A, B) of a step, in one pass; for a `PhaseStep`, of (q, p, dt)."""

    @functools.wraps(step)
    def function(x: Array, u: Array, dt: Array) -> tuple[Any, Any]:
        def twice(x: Array, u: Array) -> tuple[Any, Any]:
            x_next = step(x, u, dt)
            return x_next, x_next

        derivatives, x_next = jax.jacfwd(twice, argnums=(0, 1), has_aux=True)(x, u)
        return x_next, derivatives

    return function


def torque_slopes(tau: Float[Array, "T d"], t: Float[Array, " T"], torque: Torque) -> Float[Array, "T-1 d"]:
    """Returns the rates of the torque within the intervals; zero if it is held, and for intervals of length zero.

    Raises:
        InputError: `torque` is neither "held" nor "interpolated".
    """
    if torque not in ("held", "interpolated"):
        raise InputError(f"torque is {torque!r}; expected 'held' or 'interpolated'")
    changes = jnp.diff(tau, axis=0)
    if torque == "held":
        return jnp.zeros_like(changes)
    durations = jnp.diff(t)[:, None]
    return jnp.where(durations > 0, changes / jnp.where(durations > 0, durations, 1.0), 0.0)


def driven(
    rate: Callable[[Any, Array], Any],
    start: State,
    tau: Array,
    slopes: Array,
    durations: Array,
    *,
    substeps: int,
    method: Method = integrators.rk4,
) -> State:
    """Integrates y' = rate(y, tau(t)) and returns the states at the samples; leaves get a leading axis T.

    Args:
        rate: (state, tau) -> rate of the state.
        start: state at the first sample.
        tau: [T - 1, d], torque at the start of every interval; after a time s it is tau + slopes s.
        slopes: [T - 1, d], from `torque_slopes`.
        durations: [T - 1] in s; a duration of zero leaves the state unchanged.
        method: field -> step; `integrators.looped_rk4` compiles faster.
    """

    def interval(state: State, drive: tuple[Array, Array, Array]) -> State:
        tau, slope, duration = drive
        step = method(lambda s, state: rate(state, tau + s * slope))
        return advance(step, jnp.zeros_like(duration), state, duration, substeps=substeps)

    return from_start(interval, start, (tau, slopes, durations))


def _force(actuation: Actuation, u: Array) -> Array:
    return u if actuation is None else jnp.asarray(actuation, u.dtype) @ u


def _root(equations: Callable[[Array], Array], start: Array, x: Array, dt: Array, iterations: int) -> Array:
    """Returns the rate of a state x that solves the equations after a number of Newton steps, or NaN."""
    identity = jnp.eye(start.shape[0], dtype=start.dtype)

    def solve_linear(product: Callable[[Array], Array], right: Array) -> Array:
        # The inverse serves the many right-hand sides of a step's derivatives; elimination would repeat for each.
        return solve(jax.vmap(product, out_axes=1)(identity), identity) @ right

    def search(equations: Callable[[Array], Array], start: Array) -> tuple[Array, Array]:
        def turn(state: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
            value, product = jax.linearize(equations, state[0])
            change = solve_linear(product, value)
            return (state[0] - change, jnp.max(jnp.abs(change))), None

        return jax.lax.scan(turn, (start, jnp.zeros_like(start[0])), length=iterations)[0]

    rate, change = jax.lax.custom_root(equations, start, search, solve_linear, has_aux=True)
    settled = jnp.abs(dt) * change <= jnp.sqrt(jnp.finfo(x.dtype).eps) * (1 + jnp.max(jnp.abs(x)))
    # A factor instead of a selection, so that derivatives also become NaN.
    return rate * jnp.where(settled, jnp.ones_like(dt), jnp.nan)
