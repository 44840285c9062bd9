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
from collections.abc import Callable
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
    another, memory is that of one seed, and LAPACK is never called for a batch (see `solvers.lapack`).

    Raises:
        InputError: parameters or residuals are not float64, or arrays differ in length.
    """
    chunks, samples = in_chunks(arrays), len(arrays[0])
    return run_on_chunks(sample_residual, state, chunks, iterations, samples=samples, improvement=improvement)


def in_chunks(arrays: Arrays, mesh: Mesh | None = None) -> Chunks:
    """Returns the samples as chunks for `run_on_chunks`; `scale.mesh.shard` splits them over the devices.

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
    at = _linearise(sample_residual, state.parameters, chunks, samples, mesh)
    largest = jnp.where(state.iteration == 0, jnp.max(jnp.diagonal(at.matrix)), state.scale)
    finite = jnp.isfinite(at.loss) & jnp.all(jnp.isfinite(at.gradient))
    flat = jnp.all(at.gradient == 0)
    no, none = jnp.array(False), jnp.zeros((), int)
    start = _Trial(jnp.zeros_like(at.x), at.loss, no, state.damping, state.growth, none, none)
    last = lax.while_loop(
        lambda trial: finite & ~flat & ~trial.accepted & (trial.tried < TRIALS),
        # If no parameter has an effect, the scale is zero; any positive number will do, because the step is zero.
        lambda trial: _try(sample_residual, at, jnp.where(largest > 0, largest, 1.0), trial, mesh),
        start,
    )
    stalled = jnp.where(jnp.isfinite(last.loss), int(Status.STALLED), int(Status.NON_FINITE))
    status = jnp.select(
        [~finite, flat, ~last.accepted, at.loss - last.loss <= improvement * at.loss],
        [int(Status.NON_FINITE), int(Status.FLAT), stalled, int(Status.IMPROVEMENT)],
        int(Status.RUNNING),
    )
    return LevenbergMarquardtState(
        parameters=at.unravel(jnp.where(last.accepted, at.x + last.step, at.x)),
        iteration=state.iteration + (finite & ~flat),
        status=status.astype(state.status.dtype),  # weakly typed, it would compile another program
        loss=jnp.where(last.accepted, last.loss, at.loss),
        damping=last.damping,
        growth=last.growth,
        scale=largest,
        trials=state.trials + last.tried,
        fallbacks=state.fallbacks + last.fallbacks,
    )


class _Linearised(NamedTuple):
    parameters: Any
    x: Array
    """The parameters as a vector [P]."""
    unravel: Callable[[Array], Any]
    chunks: Chunks
    samples: int
    """Number of samples on all devices."""
    matrix: Array
    """A [P, P]."""
    gradient: Array
    """g [P]."""
    loss: Array
    jacobian: Array | None
    """Jacobian of all samples, if small enough to keep."""


def _linearise(
    sample_residual: SampleResidual, parameters: Any, chunks: Chunks, samples: int, mesh: Mesh | None
) -> _Linearised:
    x, unravel = ravel_pytree(parameters)
    rows = chunks.weights.size * equations.residual_count(sample_residual, parameters, chunks)
    keep = 8 * x.size * rows <= KEPT_BYTES
    matrix, vector, squares, jacobian = equations.normal_equations(
        sample_residual, parameters, chunks, keep=keep, mesh=mesh
    )
    matrix, vector, squares = matrix / samples, vector / samples, squares / samples
    return _Linearised(parameters, x, unravel, chunks, samples, matrix, vector, squares, jacobian)


class _Trial(NamedTuple):
    step: Array
    loss: Array
    accepted: Array
    damping: Array
    """Damping of the next trial."""
    growth: Array
    tried: Array
    fallbacks: Array


def _try(sample_residual: SampleResidual, at: _Linearised, scale: Array, trial: _Trial, mesh: Mesh | None) -> _Trial:
    """Tries the step with the current damping; returns whether it lowers the loss, and the next damping."""
    damped = trial.damping * scale
    factor, fell_back = equations.factorise(at.matrix + damped * jnp.eye(at.x.size))
    velocity = -equations.solve(factor, at.gradient)

    def accelerated(probed: Array) -> Array:
        """Returns v + a from the residuals at x + h v."""
        product = equations.pull_back(sample_residual, at.parameters, at.chunks, at.jacobian, probed, mesh=mesh)
        slope = product / at.samples
        # Finite or NaN; the selection also keeps the rounding of the division, which a fused multiply-add would skip.
        slope = jnp.where(jnp.isfinite(slope), slope, jnp.nan)
        bend = -equations.solve(factor, slope - (1 - PROBE) * at.gradient + PROBE * damped * velocity) / PROBE**2
        bounded = bend @ bend <= UPPER_ACCELERATION**2 * (velocity @ velocity)  # False for NaN
        return jnp.where(bounded, velocity + bend, velocity)

    def evaluate(phase: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        step, _ = carry
        point = jnp.where(phase == 0, PROBE * velocity, step)
        values = equations.residuals(sample_residual, at.unravel(at.x + point), at.chunks)
        step = lax.cond(phase == 0, lambda: accelerated(values), lambda: step)
        return step, total(jnp.sum(values**2), mesh) / at.samples

    # One loop body for probe and trial: the residual function is compiled once for both.
    step, loss = lax.fori_loop(0, 2, evaluate, (velocity, at.loss))
    predicted = (damped * velocity - at.gradient) @ velocity
    gain = jnp.clip((at.loss - loss) / predicted, 0, 1)
    accepted = loss < at.loss
    factor_on_damping = jnp.where(accepted, jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3), trial.growth)
    return _Trial(
        step=step,
        loss=loss,
        accepted=accepted,
        damping=jnp.maximum(trial.damping * factor_on_damping, LOWER_DAMPING),
        growth=jnp.where(accepted, 2.0, 2 * trial.growth),
        tried=trial.tried + 1,
        fallbacks=trial.fallbacks + fell_back,
    )
