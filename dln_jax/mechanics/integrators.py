"""Time stepping: `step(t, state, dt) -> state` for any pytree as state, and rollouts.

| step | order | fields | properties |
|---|---|---|---|
| `explicit_euler` | 1 | any field | |
| `rk4` | 4 | any field | |
| `implicit_midpoint` | 2 | any field | symplectic, reversible, quadratic invariants |
| `gauss_legendre4` | 4 | any field | symplectic, reversible, quadratic invariants |
| `radau3` | 3 | any field | for stiff fields at any dt: fast decay stays damped (L-stable) |
| `symplectic_euler` | 1 | partitioned fields | symplectic if separable |
| `stormer_verlet` | 2 | separable fields | symplectic, reversible |

A field is `(t, state) -> rate` of a first-order system y' = f(t, y). A partitioned field has two halves, q' = velocity
and p' = force. It is separable if the velocity depends only on p and the force only on q, as for H = T(p) + V(q). The
partitioned steps are explicit. For other Hamiltonians use `implicit_midpoint` or `gauss_legendre4`. Source: Hairer,
Lubich and Wanner, "Geometric Numerical Integration" (2006), chapters I, II and VI.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from dln_jax.rollout import rollout as steps_in_turn
from dln_jax.solvers.newton import find_root
from dln_jax.types import require_positive

State = Any
"""A pytree of real arrays, such as (q, qd) or (q, p)."""
Field = Callable[[Any, Any], Any]
"""(t, state) -> rate of the state."""
Step = Callable[[Any, Any, Any], Any]
"""(t, state, dt) -> state at t + dt; dt may be traced, and negative."""


Method = Callable[[Field], Step]
"""Field -> step, such as `rk4`, or `radau3` for stiff fields."""


def runge_kutta(
    stages: Sequence[Sequence[float]],
    weights: Sequence[float],
    field: Field,
    *,
    tolerance: float = 1e-9,
    iterations: int = 20,
) -> Step:
    """Returns a step of y' = f(t, y) by the method with coefficients a, b and c_i = sum_j a_ij.

        Y_i = y + dt sum_j a_ij f(t + c_j dt, Y_j),    y <- y + dt sum_i b_i f(t + c_i dt, Y_i)

    The method is explicit if a is strictly lower triangular. Newton's method solves for the stages of an implicit one;
    derivatives use the implicit function theorem. A step whose stages do not converge is NaN: take a smaller dt.

    Args:
        stages: a [s, s].
        weights: b [s].
        field: (t, state) -> rate.
        tolerance: largest error of the equations for Y in the state's units before the last Newton step, which roughly
            squares it. Implicit methods only.
        iterations: largest number of Newton steps; implicit methods only.
    """
    field = jax.jit(field)  # traced once for all stages
    nodes = [sum(row) for row in stages]

    def explicit(t, state: State, dt) -> State:
        rates = []
        for row, node in zip(stages, nodes, strict=True):
            rates.append(field(t + node * dt, _combine(state, dt, row, rates)))
        return _combine(state, dt, weights, rates)

    def implicit(t, state: State, dt) -> State:
        start, unravel = ravel_pytree(state)
        a, b, c = (jnp.asarray(entry, start.dtype) for entry in (stages, weights, nodes))

        def rates(values, t, dt):
            return jax.vmap(lambda t, value: ravel_pytree(field(t, unravel(value)))[0])(t + c * dt, values)

        # The unknowns are the states of the stages: their size sets the scale of rounding even if all rates vanish.
        def equations(values, start, t, dt):
            values = values.reshape(len(b), -1)
            return (values - start - dt * a @ rates(values, t, dt)).ravel()

        first = jnp.tile(start, len(b))
        values, info = find_root(equations, first, start, t, dt, tolerance=tolerance, iterations=iterations)
        end = start + dt * b @ rates(values.reshape(len(b), -1), t, dt)
        return unravel(jnp.where(info.converged, end, jnp.nan))

    return implicit if any(entry for i, row in enumerate(stages) for entry in row[i:]) else explicit


explicit_euler = functools.partial(runge_kutta, [[0.0]], [1.0])
rk4 = functools.partial(
    runge_kutta,
    [[0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)
implicit_midpoint = functools.partial(runge_kutta, [[0.5]], [1.0])
_SKEW = math.sqrt(3) / 6
gauss_legendre4 = functools.partial(runge_kutta, [[0.25, 0.25 - _SKEW], [0.25 + _SKEW, 0.25]], [0.5, 0.5])
radau3 = functools.partial(runge_kutta, [[5 / 12, -1 / 12], [0.75, 0.25]], [0.75, 0.25])


def looped_rk4(field: Field) -> Step:
    """Returns `rk4` with its stages in a loop: the compiled program contains the field once instead of four times.

    Use it where compilation takes longer than execution: fits through an integrator, and motions that run once.
    """
    nodes, weights = jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6

    def step(t: Any, state: State, dt: Any) -> State:
        def stage(carry: tuple[State, State], coefficients: tuple[Array, Array]) -> tuple[tuple[State, State], None]:
            rate, total = carry
            node, weight = coefficients
            rate = field(t + node * dt, _plus(state, node * dt, rate))
            return (rate, _plus(total, weight * dt, rate)), None

        still = jax.tree.map(jnp.zeros_like, state)
        coefficients = (nodes.astype(jnp.result_type(dt)), weights.astype(jnp.result_type(dt)))
        return jax.lax.scan(stage, (still, state), coefficients)[0][1]

    return step


def symplectic_euler(velocity: Callable[..., Any], force: Callable[..., Any]) -> Step:
    """Returns Euler's method with the new momentum in the second half; the state is (q, p).

        p <- p + dt force(t, q, p),    q <- q + dt velocity(t, q, p)

    Order 1. Symplectic if the force does not read p; (q, qd) with force = qdd(t, q, qd) is the usual
    "semi-implicit Euler" of game engines.
    """

    def step(t, state, dt):
        q, p = state
        p = _plus(p, dt, force(t, q, p))
        return _plus(q, dt, velocity(t, q, p)), p

    return step


def stormer_verlet(velocity: Callable[[Any, Any], Any], force: Callable[[Any, Any], Any]) -> Step:
    """Returns Störmer-Verlet (leapfrog) for separable systems q' = velocity(t, p), p' = force(t, q); state (q, p).

        p_half = p + dt/2 force(t, q),    q <- q + dt velocity(t + dt/2, p_half),    p <- p_half + dt/2 force(t + dt, q)

    Order 2, symplectic and reversible. The arguments of the two halves exclude fields that are not separable.
    """

    def step(t, state, dt):
        q, p = state
        p = _plus(p, dt / 2, force(t, q))
        q = _plus(q, dt, velocity(t + dt / 2, p))
        return q, _plus(p, dt / 2, force(t + dt, q))

    return step


def second_order(acceleration: Callable[[Any, Array, Array], Array]) -> Field:
    """Returns the field of q'' = acceleration(t, q, qd), on the state (q, qd)."""

    def field(t, state):
        q, qd = state
        return qd, acceleration(t, q, qd)

    return field


def advance(step: Step, t, state: State, duration, *, substeps: int = 1) -> State:
    """Returns the state after `duration`, in `substeps` equal steps."""
    dt = duration / substeps
    if substeps == 1:
        return step(t, state, dt)

    def body(state, index):
        return step(t + index * dt, state, dt), None

    # A scan, because a loop with a traced count has no reverse-mode derivative.
    return jax.lax.scan(body, state, jnp.arange(substeps))[0]


def rollout(step: Step, state: State, t: Float[Array | np.ndarray, " T"], *, substeps: int = 1) -> State:
    """Returns the states at the times t [T], including the initial one; leaves get a leading axis T.

    Args:
        step: (t, state, dt) -> state.
        state: state at t[0].
        t: times in s, any spacing, forward or backward.
        substeps: steps per interval; only the states at t are kept.
    """
    require_positive(substeps=substeps)
    # A step must not change the type of its state.
    times = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(state)))

    def interval(state, start_and_duration):
        return advance(step, start_and_duration[0], state, start_and_duration[1], substeps=substeps)

    return from_start(interval, state, (times[:-1], jnp.diff(times)))


def from_start(step: Callable[[State, Any], State], state: State, inputs: Any) -> State:
    """Returns the initial state and the state after each step (state, input) -> state; leaves get a leading axis."""
    _, later = steps_in_turn(lambda state, input: (step(state, input), None), state, inputs)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state, later)


def adaptive_rollout(
    field: Field, state: State, t: Float[Array | np.ndarray, " T"], *, tolerance: float, max_steps: int = 100_000
) -> tuple[State, Bool[Array, ""]]:
    """Returns states at the times t [T] by Dormand-Prince 8 with step-size control, and whether it finished.

    Args:
        field: (t, state) -> rate.
        state: state at t[0].
        t: increasing times in s.
        tolerance: tolerance on the error per step, relative and absolute.
        max_steps: largest number of steps; states not reached are infinite.
    """
    import diffrax  # slower to import than the rest of the package

    require_positive(tolerance=tolerance)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, state, _: field(t, state)),
        diffrax.Dopri8(),
        t0=t[0],
        t1=t[-1],
        dt0=None,
        y0=state,
        saveat=diffrax.SaveAt(ts=jnp.asarray(t)),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        max_steps=max_steps,
        throw=False,
    )
    return solution.ys, solution.result == diffrax.RESULTS.successful


def _plus(state: State, dt, rate: State) -> State:
    return jax.tree.map(lambda value, slope: value + dt * slope, state, rate)


def _combine(state: State, dt, weights: Sequence[float], rates: list[State]) -> State:
    used = [(weight, rate) for weight, rate in zip(weights, rates, strict=False) if weight]
    if not used:
        return state
    scaled = [jax.tree.map(lambda slope, weight=weight: weight * slope, rate) for weight, rate in used]
    return _plus(state, dt, jax.tree.map(lambda *slopes: sum(slopes), *scaled))
