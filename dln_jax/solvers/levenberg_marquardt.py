"""Levenberg-Marquardt for any residual function and any tree of parameters, in float64.

Minimises F(x) = (1/N) sum over samples of |r_n(x)|². With J = dr/dx, an iteration evaluates A = JᵀJ / N and
g = Jᵀr / N once, and tries dampings until one lowers F:

    (A + damping s I) v = -g                                                           velocity
    (A + damping s I) a = -(J(x)ᵀ r(x + h v) / N - (1 - h) g + h damping s v) / h²     acceleration
    x <- x + v + a,  or x + v where |a| > 0.75 |v|

where s is the largest diagonal entry of the first A. Here a is the geodesic acceleration of Transtrum and Sethna (2012,
arXiv:1201.5885), with the second derivative of r along v as a finite difference of step h. It takes a residual, a
product and a solve with the same factor, and follows the curved valleys of networks: a two-link arm with 260 parameters
reached a loss of 1e-8 in 24 to 34 iterations instead of 110 to 190. The damping is Nielsen's (1999, IMM-REP-1999-05):
times max(1/3, 1 - (2 gain - 1)³) after a success, times 2, 4, 8, ... after successive failures, where gain is the
decrease of F relative to that predicted by the quadratic model for v.

Normal equations square the condition number of J. They are solved by Cholesky if the damped matrix is regular in
working precision, else by eigenvalues (`normal_equations.factorise`), which the state counts as a fallback. All
functions are pure; the caller compiles them.

The devices of a mesh share the samples: each sums J Jᵀ, J r, J w and |r|² over its samples, and all solve the same
equations. Sums are reduced over devices once per iteration (P² / 2 numbers) and three times per trial (P + 2).
"""

import enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from dln_jax.scale import first, on_devices, total
from dln_jax.solvers import normal_equations as equations
from dln_jax.solvers.normal_equations import Chunks, SampleResidual

Arrays = tuple[Any, ...]
"""Arrays with samples on axis 0; `None` is passed through."""
FIRST_DAMPING = 1e-3
"""Initial damping, relative to the largest diagonal entry of the first A."""
LOWER_DAMPING = 1e-16
UPPER_ACCELERATION = 0.75
"""Largest |a| / |v| of accelerations that are used; 0 disables them."""
PROBE = 0.5
"""Step h of the finite difference for the second derivative along v."""
CHUNK = 256
"""Number of samples whose Jacobian is evaluated at once."""
KEPT_BYTES = 2**30
"""Largest Jacobian kept through an iteration (see `jacobian_bytes`); beyond it, reverse mode gives its products."""
TRIALS = 16
"""Steps tried before an iteration gives up."""


class Status(enum.IntEnum):
    """Whether an optimisation is running, or why it ended."""

    RUNNING = 0
    FLAT = 1
    """The gradient is zero."""
    IMPROVEMENT = 2
    """The relative improvement of an iteration fell to the requested limit."""
    STALLED = 3
    """No damping lowers the loss: it has reached the limit of the precision, or the derivatives are wrong."""
    NON_FINITE = 4
    """The loss is not finite at the start or in the last trial of an iteration; the parameters are unchanged."""


class LevenbergMarquardtState(NamedTuple):
    """Everything that the next iteration depends on: arrays, with a leading axis for several seeds."""

    parameters: Any
    """Tree of float64 arrays."""
    iteration: Array
    status: Array
    """A `Status`; anything but RUNNING makes `run` the identity."""
    loss: Array
    """Mean over samples of the sum of squared residuals; infinite before the first iteration."""
    damping: Array
    """Factor on s."""
    growth: Array
    """Factor on the damping after the next failure."""
    scale: Array
    """s."""
    trials: Array
    """Number of steps tried so far."""
    fallbacks: Array
    """Number of failed Cholesky factorisations so far."""


def init(parameters: Any) -> LevenbergMarquardtState:
    """Returns the state before the first iteration; its arrays are copies, so that a caller may donate them.

    Raises:
        InputError: the parameters are not float64.
    """
    equations.check_precision(parameters, "parameters")
    none = jnp.zeros((), int)
    return LevenbergMarquardtState(
        parameters=jax.tree.map(jnp.array, parameters),
        iteration=none,
        status=jnp.full((), int(Status.RUNNING), int),
        loss=jnp.full((), jnp.inf, float),
        damping=jnp.full((), FIRST_DAMPING, float),
        growth=jnp.full((), 2.0, float),
        scale=jnp.zeros(()),
        trials=none,
        fallbacks=none,
    )


def run(
    sample_residual: SampleResidual,
    state: LevenbergMarquardtState,
    arrays: Arrays,
    iterations: Any,
    *,
    improvement: float = 0.0,
) -> LevenbergMarquardtState:
    """Runs `iterations` iterations, fewer if the status changes or one lowers F by no more than `improvement` F.

    States with a leading axis of seeds run one after the other, not in lockstep: no seed repeats the failed trials of
    another, memory is that of one seed, and LAPACK is never called for a batch (see `solvers.elimination`).

    Raises:
        InputError: parameters or residuals are not float64, or arrays differ in length.
    """
    chunks, samples = in_chunks(arrays), len(arrays[0])
    return run_on_chunks(sample_residual, state, chunks, iterations, samples=samples, improvement=improvement)


def in_chunks(arrays: Arrays, mesh: Mesh | None = None) -> Chunks:
    """Returns the samples as chunks for `run_on_chunks`; `scale.shard` splits them over the devices.

    Raises:
        InputError: arrays differ in length.
    """
    return equations.split(arrays, CHUNK, devices=1 if mesh is None else mesh.size)


def run_on_chunks(
    sample_residual: SampleResidual,
    state: LevenbergMarquardtState,
    chunks: Chunks,
    iterations: Any,
    *,
    samples: int,
    improvement: float = 0.0,
    mesh: Mesh | None = None,
) -> LevenbergMarquardtState:
    """Runs iterations like `run`, with the chunks of samples shared by the devices of a mesh."""

    @jax.custom_batching.sequential_vmap
    def run_one(state: LevenbergMarquardtState, chunks: Chunks, iterations: Array) -> LevenbergMarquardtState:
        end = state.iteration + iterations
        return lax.while_loop(
            lambda state: (state.status == Status.RUNNING) & (state.iteration < end),
            lambda state: _iterate(sample_residual, state, chunks, samples, improvement=improvement, mesh=mesh),
            state,
        )

    def on_one(shared: tuple[LevenbergMarquardtState, Array], chunks: Chunks) -> LevenbergMarquardtState:
        state, iterations = shared
        over_seeds = jax.vmap(run_one, in_axes=(0, None, None)) if state.iteration.ndim else run_one
        # Devices may round the solution differently, so all continue from the first device's.
        return first(over_seeds(state, chunks, iterations), mesh)

    return on_devices(on_one, mesh)((state, jnp.asarray(iterations)), chunks)


def _iterate(
    sample_residual: SampleResidual,
    state: LevenbergMarquardtState,
    chunks: Chunks,
    samples: int,
    *,
    improvement: float,
    mesh: Mesh | None,
) -> LevenbergMarquardtState:
    """Runs one iteration of one seed, whatever its status; loops and branches depend only on sums over all devices."""
    parameters = state.parameters
    x, unravel = ravel_pytree(parameters)
    rows = chunks.weights.size * equations.residual_count(sample_residual, parameters, chunks)
    keep = 8 * x.size * rows <= KEPT_BYTES
    matrix, gradient, squares, jacobian = equations.normal_equations(
        sample_residual, parameters, chunks, keep=keep, mesh=mesh
    )
    matrix, gradient, squares = matrix / samples, gradient / samples, squares / samples
    largest = jnp.where(state.iteration == 0, jnp.max(jnp.diagonal(matrix)), state.scale)
    # If no parameter has an effect, the scale is zero; any positive number will do, because the step is zero.
    scale = jnp.where(largest > 0, largest, 1.0)
    finite = jnp.isfinite(squares) & jnp.all(jnp.isfinite(gradient))
    flat = jnp.all(gradient == 0)

    def attempt(trial: tuple[Array, ...]) -> tuple[Array, ...]:
        """Tries the step with the current damping, and finds whether it lowers the loss, and the next damping."""
        _, _, _, damping, growth, tried, fallbacks = trial
        damped = damping * scale
        factor, fell_back = equations.factorise(matrix + damped * jnp.eye(x.size))
        velocity = -equations.solve(factor, gradient)

        def accelerated(probed: Array) -> Array:
            """Returns v + a from the residuals at x + h v."""
            product = equations.pull_back(sample_residual, parameters, chunks, jacobian, probed, mesh=mesh)
            slope = product / samples
            # Finite or NaN; the selection also keeps the rounding of the division, which a fused multiply-add would
            # skip.
            slope = jnp.where(jnp.isfinite(slope), slope, jnp.nan)
            bend = -equations.solve(factor, slope - (1 - PROBE) * gradient + PROBE * damped * velocity) / PROBE**2
            bounded = bend @ bend <= UPPER_ACCELERATION**2 * (velocity @ velocity)  # False for NaN
            return jnp.where(bounded, velocity + bend, velocity)

        def evaluate(phase: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            step, _ = carry
            point = jnp.where(phase == 0, PROBE * velocity, step)
            values = equations.residuals(sample_residual, unravel(x + point), chunks)
            step = lax.cond(phase == 0, lambda: accelerated(values), lambda: step)
            return step, total(jnp.sum(values**2), mesh) / samples

        # One loop body for probe and trial: the residual function is compiled once for both.
        step, loss = lax.fori_loop(0, 2, evaluate, (velocity, squares))
        predicted = (damped * velocity - gradient) @ velocity
        gain = jnp.clip((squares - loss) / predicted, 0, 1)
        accepted = loss < squares
        factor_on_damping = jnp.where(accepted, jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3), growth)
        damping = jnp.maximum(damping * factor_on_damping, LOWER_DAMPING)
        growth = jnp.where(accepted, 2.0, 2 * growth)
        return step, loss, accepted, damping, growth, tried + 1, fallbacks + fell_back

    def unfinished(trial: tuple[Array, ...]) -> Array:
        _, _, accepted, *_, tried, _ = trial
        return finite & ~flat & ~accepted & (tried < TRIALS)

    none = jnp.zeros((), int)
    start = jnp.zeros_like(x), squares, jnp.array(False), state.damping, state.growth, none, none
    step, loss, accepted, damping, growth, tried, fallbacks = lax.while_loop(unfinished, attempt, start)
    stalled = jnp.where(jnp.isfinite(loss), int(Status.STALLED), int(Status.NON_FINITE))
    status = jnp.select(
        [~finite, flat, ~accepted, squares - loss <= improvement * squares],
        [int(Status.NON_FINITE), int(Status.FLAT), stalled, int(Status.IMPROVEMENT)],
        int(Status.RUNNING),
    )
    return LevenbergMarquardtState(
        parameters=unravel(jnp.where(accepted, x + step, x)),
        iteration=state.iteration + (finite & ~flat),
        status=status.astype(state.status.dtype),  # weakly typed, it would compile another program
        loss=jnp.where(accepted, loss, squares),
        damping=damping,
        growth=growth,
        scale=largest,
        trials=state.trials + tried,
        fallbacks=state.fallbacks + fallbacks,
    )
