"""Levenberg-Marquardt for any residual function and any tree of parameters, in float64.

Minimises F(x) = (1/N) sum over samples of |r_n(x)|². With J = dr/dx, an iteration evaluates A = JᵀJ / N and
g = Jᵀr / N once, and tries dampings until one lowers F:

    (A + damping s I) v = -g                                                           velocity
    (A + damping s I) a = -(J(x)ᵀ r(x + h v) / N - (1 - h) g + h damping s v) / h²     acceleration
    x <- x + v + a,  or x + v where |a| > 0.75 |v|

where s is the largest diagonal entry of the first A. This a is the geodesic acceleration of Transtrum and Sethna (2012,
arXiv:1201.5885), whose second derivative of r along v is a difference with probe h. It takes a residual, a product and
a solve with the same factor, and follows the curved valleys of networks: a two-link arm with 260 parameters was at a
loss of 1e-8 in 24 to 34 iterations instead of 110 to 190. The damping is Nielsen's (1999, IMM-REP-1999-05): times
max(1/3, 1 - (2 gain - 1)³) after a success, times 2, 4, 8, ... after failures in a row, where gain is the decrease of
F over that which the quadratic model predicts for v.

Normal equations square the condition number of J. They are solved by Cholesky while the damped matrix is regular in
working precision, else by eigenvalues (`normal_equations.factorise`), which the state counts as a fallback. All
functions are pure; the caller compiles them.

Devices of a mesh share the samples: each sums J Jᵀ, J r, J w and |r|² over its own, and all solve the same equations.
The sums are brought together once in an iteration, P² / 2 numbers, and three times in a trial, P + 2.
"""

import enum
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh

from dln_jax.scale.mesh import first, on_devices, total
from dln_jax.solvers import normal_equations as equations
from dln_jax.solvers.normal_equations import Chunks, SampleResidual

Arrays = tuple[Any, ...]
"""Samples on axis 0; `None` is handed on as it is."""
FIRST_DAMPING = 1e-3
"""Relative to the largest diagonal entry of the first A."""
LOWER_DAMPING = 1e-16
UPPER_ACCELERATION = 0.75
"""The largest |a| / |v| that is used; 0 leaves acceleration out."""
PROBE = 0.5
"""h."""
CHUNK = 256
"""Samples whose Jacobian is evaluated at once."""
KEPT_BYTES = 2**30
"""A Jacobian that takes no more is kept through an iteration; else its product for the acceleration is evaluated by
reverse mode. `normal_equations.jacobian_bytes` states the memory."""
TRIALS = 16
"""Steps tried before an iteration gives up."""


class Status(enum.IntEnum):
    """Why an optimisation ended, or that it has not."""

    RUNNING = 0
    FLAT = 1
    """The gradient is zero."""
    IMPROVEMENT = 2
    """An iteration improved as little as asked."""
    STALLED = 3
    """No damping lowers the loss any more: it is at its floor in this precision, or the derivatives are wrong."""
    NON_FINITE = 4
    """The loss is not finite where an iteration starts, or in its last trial; the parameters are as they were."""


class LevenbergMarquardtState(NamedTuple):
    """All that the next iteration depends on: arrays only, with a leading axis of seeds where there are several."""

    parameters: Any
    """Tree of float64 arrays."""
    iteration: Array
    """Iterations done."""
    status: Array
    """A `Status`; anything but RUNNING makes `run` the identity."""
    loss: Array
    """Mean over samples of the sum of squared residuals; inf before the first iteration."""
    damping: Array
    """Factor on s."""
    growth: Array
    """Factor on the damping after the next failure."""
    scale: Array
    """s."""
    trials: Array
    """Steps tried so far."""
    fallbacks: Array
    """Factorisations so far that Cholesky could not do."""


def init(parameters: Any) -> LevenbergMarquardtState:
    """The state before the first iteration; its arrays are copies, so that a caller may donate them.

    Raises:
        InputError: parameters that are not float64.
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
    """So many iterations, fewer where the status says so, or an iteration lowers F by no more than `improvement` F.

    States with a leading axis of seeds are taken one after the other instead of all in lockstep: no seed repeats
    another's failed trials, memory is that of one, and LAPACK is never called for a batch (see `solvers.lapack`).

    Raises:
        InputError: parameters or residuals that are not float64, or arrays of different length.
    """
    chunks, samples = in_chunks(arrays), len(arrays[0])
    return run_on_chunks(sample_residual, state, chunks, iterations, samples=samples, improvement=improvement)


def in_chunks(arrays: Arrays, mesh: Mesh | None = None) -> Chunks:
    """Samples as `run_on_chunks` takes them, which `scale.mesh.shard` splits over the devices of the mesh.

    Raises:
        InputError: arrays of different length.
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
    """What `run` does for so many samples, by the devices of a mesh together, each with its chunks of them."""

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
        # Devices of other makes round the solution of the equations otherwise: all go on from the first one's.
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
    """One iteration of one seed, whatever its status. Loops and branches depend on sums over all devices alone."""
    at = _linearise(sample_residual, state.parameters, chunks, samples, mesh)
    largest = jnp.where(state.iteration == 0, jnp.max(jnp.diagonal(at.matrix)), state.scale)
    finite = jnp.isfinite(at.loss) & jnp.all(jnp.isfinite(at.gradient))
    flat = jnp.all(at.gradient == 0)
    no, none = jnp.array(False), jnp.zeros((), int)
    start = _Trial(jnp.zeros_like(at.x), at.loss, no, state.damping, state.growth, none, none)
    last = lax.while_loop(
        lambda trial: finite & ~flat & ~trial.accepted & (trial.tried < TRIALS),
        # Where no parameter has an effect the scale is zero: any positive number will do, for the step is zero.
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
        status=status.astype(state.status.dtype),  # no longer weakly typed: that would be another program
        loss=jnp.where(last.accepted, last.loss, at.loss),
        damping=last.damping,
        growth=last.growth,
        scale=largest,
        trials=state.trials + last.tried,
        fallbacks=state.fallbacks + last.fallbacks,
    )


class _Linearised(NamedTuple):
    """The problem at the parameters where an iteration starts."""

    parameters: Any
    x: Array
    """The same as a vector [P]."""
    unravel: Callable[[Array], Any]
    chunks: Chunks
    samples: int
    """Of all devices."""
    matrix: Array
    """A [P, P]."""
    gradient: Array
    """g [P]."""
    loss: Array
    jacobian: Array | None
    """Of all samples, where it is small enough to be kept."""


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
    """One damping, and what came of it."""

    step: Array
    loss: Array
    accepted: Array
    damping: Array
    """For the next trial."""
    growth: Array
    tried: Array
    fallbacks: Array


def _try(sample_residual: SampleResidual, at: _Linearised, scale: Array, trial: _Trial, mesh: Mesh | None) -> _Trial:
    """The step with the damping of the last trial, whether it lowers the loss, and the next damping."""
    damped = trial.damping * scale
    factor, fell_back = equations.factorise(at.matrix + damped * jnp.eye(at.x.size))
    velocity = -equations.solve(factor, at.gradient)

    def accelerated(probed: Array) -> Array:
        """v + a, by the residuals at x + h v."""
        product = equations.pull_back(sample_residual, at.parameters, at.chunks, at.jacobian, probed, mesh=mesh)
        slope = product / at.samples
        # Finite or NaN; the selection keeps the rounding of the division, which a fused multiply-add would skip.
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
