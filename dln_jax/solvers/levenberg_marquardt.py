"""Levenberg-Marquardt for any residual function and any tree of parameters, in float64.

Minimises F(x) = (1/N) sum over samples of |r_n(x)|² + ridge |x|². With J = dr/dx, an iteration evaluates
A = JᵀJ / N + ridge I and g = Jᵀr / N + ridge x once, and tries dampings until one lowers F:

    (A + damping D) v = -g                                                             velocity
    (A + damping D) a = -(G(x + h v) - (1 - h) g + h damping D v) / h²                 acceleration
    x <- x + v + a,  or x + v where |a| > acceleration |v| in the norm of D

with G(y) = J(x)ᵀ r(y) / N + ridge y. This a is the geodesic acceleration of Transtrum and Sethna (2012,
arXiv:1201.5885), whose second derivative of r along v is a difference with probe h. It takes a residual, a product and
a solve with the same factor, and follows the curved valleys of networks: a two-link arm with 260 parameters was at a
loss of 1e-8 in 24 to 34 iterations instead of 110 to 190. The damping is Nielsen's (1999, IMM-REP-1999-05): times
max(1/3, 1 - (2 gain - 1)³) after a success, times 2, 4, 8, ... after failures in a row, where gain is the decrease of
F over that which the quadratic model predicts for v.

Normal equations square the condition number of J. They are solved by Cholesky while the damped matrix is regular in
working precision, else by eigenvalues (`normal_equations.factorise`), which the state counts as a fallback.

`step` and `run` are pure. Under `jax.vmap` over states they take one state after the other instead of all in lockstep:
no seed repeats another's failed trials, memory is that of one, and LAPACK is never called for a batch (several such
calls in one program can wait for each other for ever on a machine with few cores, seen with jaxlib 0.10.2).
"""

import enum
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.flatten_util import ravel_pytree

from dln_jax.solvers import normal_equations as equations
from dln_jax.solvers.normal_equations import SampleResidual
from dln_jax.types import InputError

Arrays = tuple[Array, ...]
"""Data, samples first: the sample n is `tuple(array[n] for array in arrays)`."""
Scaling = Literal["uniform", "diagonal"]


class Status(enum.IntEnum):
    """Why an optimisation ended, or that it has not."""

    RUNNING = 0
    GRADIENT = 1
    STEP = 2
    IMPROVEMENT = 3
    STALLED = 4
    NON_FINITE = 5
    ITERATIONS = 6
    TIME = 7
    TARGET = 8


class State(NamedTuple):
    """All that the next iteration depends on: arrays only, with a leading axis of seeds where there are several."""

    parameters: Any
    """Tree of float64 arrays."""
    key: Array
    """Raw random key of the run, uint32; each iteration folds its number in."""
    iteration: Array
    """Iterations done."""
    status: Array
    """A `Status`; anything but RUNNING makes `step` the identity."""
    loss: Array
    """Mean over samples (the rows of the last iteration) of the sum of squared residuals; inf before the first."""
    gradient_norm: Array
    """Largest entry of |dF/dx| where the last iteration started."""
    step_norm: Array
    """Length of the last step."""
    damping: Array
    """Factor on D."""
    growth: Array
    """Factor on the damping after the next failure."""
    scale: Array
    """Diagonal of D [P]."""
    trials: Array
    """Steps tried so far."""
    fallbacks: Array
    """Factorisations so far that Cholesky could not do."""
    best_parameters: Any
    """Those with the least validation so far; kept by `gauss_newton.minimise`, passed through by `step`."""
    best_validation: Array
    """That validation; inf where there was none."""


class LevenbergMarquardt(NamedTuple):
    """An optimiser, as functions."""

    init: Callable[..., State]
    """(parameters, key=None) -> State. Raises InputError if parameters are not float64."""
    step: Callable[[State, Arrays], State]
    """One iteration."""
    run: Callable[[State, Arrays, Any], State]
    """(state, arrays, iterations): as many iterations in one compiled call, fewer where a rule stops them."""


def make_levenberg_marquardt(
    sample_residual: SampleResidual,
    *,
    ridge: float = 0.0,
    damping: float = 1e-3,
    least_damping: float = 1e-16,
    scaling: Scaling = "uniform",
    acceleration: float = 0.75,
    probe: float = 0.5,
    rows: int | None = None,
    chunk_size: int = 256,
    kept_bytes: int = 2**30,
    trials: int = 16,
    gradient_tolerance: float = 0.0,
    step_tolerance: float = 0.0,
    improvement_tolerance: float = 0.0,
    compiler_options: Mapping[str, bool | int] | None = None,
) -> LevenbergMarquardt:
    """An optimiser for `sample_residual(parameters, *sample) -> [r]`, a function of one sample.

    A loss that is not finite where an iteration starts, or in its last trial, ends the run with the parameters as they
    were (NON_FINITE).

    Args:
        sample_residual: the residuals of one sample.
        ridge: weight of |x|² in F, in units of F over those of the parameters squared.
        damping: the first, relative to D.
        least_damping: the smallest, relative to D.
        scaling: D is I times the largest diagonal entry of the first A ("uniform", better for networks), or the running
            maximum of the diagonal of A ("diagonal", Moré 1978: for parameters of different units).
        acceleration: the largest |a| / |v| that is used; 0 leaves acceleration out.
        probe: h, in (0, 1].
        rows: samples drawn anew for each iteration, without replacement; None takes all.
        chunk_size: samples whose Jacobian is evaluated at once.
        kept_bytes: where the Jacobian takes no more than this, it is kept through an iteration; else its product for
            the acceleration is evaluated by reverse mode. `normal_equations.jacobian_bytes` states the memory.
        trials: steps tried before an iteration gives up (STALLED).
        gradient_tolerance: stop when no entry of |dF/dx| is larger.
        step_tolerance: stop when |step| <= step_tolerance (|x| + step_tolerance).
        improvement_tolerance: stop when an iteration lowers F by no more than this times F.
        compiler_options: XLA's, for `jax.jit`; `compilation.quick_compilation()` is for short runs.

    Raises:
        InputError: a scaling that does not exist, a probe outside (0, 1]; and, when the functions are called,
            parameters or residuals that are not float64, arrays of different length, more `rows` than samples.
    """
    if scaling not in get_args(Scaling) or not 0 < probe <= 1:
        raise InputError(f"scaling {scaling!r}, probe {probe}; expected one of {get_args(Scaling)}, and 0 < probe <= 1")

    def init(parameters: Any, key: Array | None = None) -> State:
        equations.check_precision(parameters, "parameters")
        key = jax.random.key(0) if key is None else key
        # Copies: a caller may donate the state.
        return State(
            parameters=jax.tree.map(jnp.array, parameters),
            key=jax.random.key_data(key),
            iteration=jnp.zeros((), int),
            status=jnp.full((), int(Status.RUNNING), int),
            loss=jnp.full((), jnp.inf, float),
            gradient_norm=jnp.full((), jnp.inf, float),
            step_norm=jnp.full((), jnp.inf, float),
            damping=jnp.full((), damping, float),
            growth=jnp.full((), 2.0, float),
            scale=jnp.zeros(equations.count(parameters)),
            trials=jnp.zeros((), int),
            fallbacks=jnp.zeros((), int),
            best_parameters=jax.tree.map(jnp.array, parameters),
            best_validation=jnp.full((), jnp.inf, float),
        )

    def drawn(state: State, available: int) -> Array:
        if rows is None:
            return jnp.arange(available)
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), state.iteration)
        return jax.random.permutation(key, available)[:rows]

    def iterate(state: State, arrays: Arrays) -> State:
        samples, residuals = equations.check_data(sample_residual, state.parameters, arrays, rows)
        x, unravel = ravel_pytree(state.parameters)
        keep = acceleration > 0 and 8 * x.size * samples * residuals <= kept_bytes
        chunks = equations.split(arrays, drawn(state, arrays[0].shape[0]), chunk_size)
        sums = equations.normal_equations(sample_residual, state.parameters, chunks, keep=keep)
        matrix = sums.matrix / samples + ridge * jnp.eye(x.size)
        gradient = sums.vector / samples + ridge * x
        loss = sums.squares / samples
        objective = loss + ridge * x @ x
        largest = _scale(state, jnp.diagonal(matrix), scaling)
        # A parameter without effect has a zero there: any positive number will do, for its step is zero.
        scale = jnp.where(largest > 0, largest, 1.0)

        def try_damping(trial: _Trial) -> _Trial:
            damped = trial.damping * scale
            factor, fell_back = equations.factorise(matrix + jnp.diag(damped))
            velocity = -equations.solve(factor, gradient)

            def at(phase, carry):
                step, _ = carry
                point = jnp.where(phase == 0, probe * velocity, step)
                values = equations.residuals(sample_residual, unravel(x + point), chunks)

                def accelerate() -> Array:
                    product = equations.pull_back(sample_residual, state.parameters, chunks, sums.jacobian, values)
                    slope = product / samples + ridge * (x + point)
                    excess = slope - (1 - probe) * gradient + probe * damped * velocity
                    bend = -equations.solve(factor, excess) / probe**2
                    bounded = scale @ bend**2 <= acceleration**2 * (scale @ velocity**2)  # False for NaN
                    return jnp.where(bounded, velocity + bend, velocity)

                return lax.cond(phase == 0, accelerate, lambda: step), jnp.sum(values**2) / samples

            # One loop body for probe and trial: the residual function is compiled once for both.
            step, new_loss = lax.fori_loop(0 if acceleration > 0 else 1, 2, at, (velocity, objective))
            new_objective = new_loss + ridge * (x + step) @ (x + step)
            predicted = (damped * velocity - gradient) @ velocity
            gain = jnp.clip((objective - new_objective) / predicted, 0, 1)
            accepted = new_objective < objective
            factor_on_damping = jnp.where(accepted, jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3), trial.growth)
            return _Trial(
                step=step,
                loss=new_loss,
                objective=new_objective,
                accepted=accepted,
                short=jnp.linalg.norm(step) <= step_tolerance * (jnp.linalg.norm(x) + step_tolerance),
                damping=jnp.maximum(trial.damping * factor_on_damping, least_damping),
                growth=jnp.where(accepted, 2.0, 2 * trial.growth),
                tried=trial.tried + 1,
                fallbacks=trial.fallbacks + fell_back,
            )

        finite = jnp.isfinite(objective) & jnp.all(jnp.isfinite(gradient))
        gradient_norm = 2 * jnp.max(jnp.abs(gradient))
        flat = gradient_norm <= gradient_tolerance
        no, none = jnp.array(False), jnp.zeros((), int)
        start = _Trial(jnp.zeros_like(x), loss, objective, no, no, state.damping, state.growth, none, none)
        last = lax.while_loop(
            lambda trial: finite & ~flat & ~trial.accepted & ~trial.short & (trial.tried < trials), try_damping, start
        )
        stalled = jnp.where(jnp.isfinite(last.objective), int(Status.STALLED), int(Status.NON_FINITE))
        small = objective - last.objective <= improvement_tolerance * objective
        status = jnp.select(
            [~finite, flat, last.short, ~last.accepted, small],
            [int(Status.NON_FINITE), int(Status.GRADIENT), int(Status.STEP), stalled, int(Status.IMPROVEMENT)],
            int(Status.RUNNING),
        )
        return State(
            parameters=unravel(jnp.where(last.accepted, x + last.step, x)),
            key=state.key,
            iteration=state.iteration + (finite & ~flat),
            status=status.astype(state.status.dtype),  # no longer weakly typed: that would be another program
            loss=jnp.where(last.accepted, last.loss, loss),
            gradient_norm=gradient_norm,
            step_norm=jnp.where(last.accepted, jnp.linalg.norm(last.step), 0.0),
            damping=last.damping,
            growth=last.growth,
            scale=largest,
            trials=state.trials + last.tried,
            fallbacks=state.fallbacks + last.fallbacks,
            best_parameters=state.best_parameters,
            best_validation=state.best_validation,
        )

    @jax.custom_batching.sequential_vmap
    def run_one(state: State, arrays: Arrays, iterations: Array) -> State:
        end = state.iteration + iterations
        return lax.while_loop(
            lambda state: (state.status == Status.RUNNING) & (state.iteration < end),
            lambda state: iterate(state, arrays),
            state,
        )

    def run(state: State, arrays: Arrays, iterations: Any) -> State:
        over_seeds = jax.vmap(run_one, in_axes=(0, None, None)) if state.iteration.ndim else run_one
        return over_seeds(state, arrays, jnp.asarray(iterations))

    compiled = jax.jit(run, compiler_options=None if compiler_options is None else dict(compiler_options))
    return LevenbergMarquardt(init, lambda state, arrays: compiled(state, arrays, 1), compiled)


class _Trial(NamedTuple):
    """One damping, and what came of it."""

    step: Array
    loss: Array
    objective: Array
    accepted: Array
    short: Array
    damping: Array
    growth: Array
    tried: Array
    fallbacks: Array


def _scale(state: State, diagonal: Array, scaling: Scaling) -> Array:
    """Diagonal of D."""
    if scaling == "diagonal":
        return jnp.maximum(state.scale, diagonal)
    return jnp.where(state.iteration == 0, jnp.full_like(diagonal, jnp.max(diagonal)), state.scale)
