"""Learning while a robot works: samples accumulate in a replay buffer, and a model is refitted to all of them.

    start, replay = model.init(key), empty_replay(2000, 2)
    for outcome, parameters, replay in learn_online(references, drive, refit, start, replay): ...

A replay buffer has a fixed capacity, and empty places have weight zero, so all refits of a growing data set share one
compiled program. A refit minimises

    sum over samples n and joints j of w_n (tau_hat_nj - tau_nj)² / variance of tau_j,   w_n = 1 for fitted samples

with tau_hat from the inverse dynamics of the model. Learning online with the model in the loop is the second experiment
of Lutter, Ritter and Peters (2019, arXiv:1907.04490).
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.learning.engine.problem import better_of, mean_square, no_best
from dln_jax.learning.linear import design, unravelled
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.precision import compiled
from dln_jax.solvers import least_squares, levenberg_marquardt
from dln_jax.types import InputError, require_positive

BLOCKS = 10
"""Parts of a recording; one of them is held out."""


class Replay(NamedTuple):
    """Samples recorded so far, in arrays of fixed size."""

    q: Float[Any, "N d"]
    qd: Float[Any, "N d"]
    qdd: Float[Any, "N d"]
    tau: Float[Any, "N d"]
    fitted: Float[Any, " N"]
    """1 for samples to fit, otherwise 0."""
    held_out: Float[Any, " N"]
    """1 for samples that select the best iterate of a refit, otherwise 0."""

    @property
    def recorded(self) -> int:
        """Number of samples, fitted or held out."""
        return int(np.count_nonzero(np.asarray(self.fitted) + np.asarray(self.held_out)))


def empty_replay(capacity: int, d: int) -> Replay:
    """Returns an empty replay with `capacity` places for samples of d joints; `InputError` unless both are positive."""
    require_positive(capacity=capacity, d=d)
    motion, weight = np.zeros((capacity, d)), np.zeros(capacity)
    return Replay(motion, motion, motion, motion, weight, weight)


def append_recording(replay: Replay, q: Any, qd: Any, qdd: Any, tau: Any) -> Replay:
    """Adds a recording to the next empty places of a replay.

    The middle one of ten equal parts of the recording is held out, unless there are fewer than ten samples.

    Args:
        q, qd, qdd, tau: the recording [n, d], in order of time.

    Raises:
        InputError: numbers that are not finite, arrays of other shapes, or more samples than places.
    """
    used, arrays = replay.recorded, [np.asarray(array, float) for array in (q, qd, qdd, tau)]
    (capacity, d), samples = np.shape(replay.q), len(arrays[0])
    if any(array.shape != (samples, d) for array in arrays):
        shapes = ", ".join(str(array.shape) for array in arrays)
        raise InputError(f"q, qd, qdd and tau have shapes {shapes}; expected [n, {d}] for all")
    if not np.isfinite(arrays).all():
        raise InputError("the recording has numbers that are not finite; leave those samples out")
    if used + samples > capacity:
        raise InputError(f"the replay has {capacity - used} empty places for {samples} samples; make it larger")
    held_out = (np.arange(samples) * BLOCKS // max(samples, 1) == BLOCKS // 2) & (samples >= BLOCKS)
    longer = Replay(*map(np.array, replay))
    for array, rows in zip(longer, (*arrays, 1.0 - held_out, held_out), strict=True):
        array[used : used + samples] = rows
    return longer


Refit = Callable[[Parameters, Replay], Parameters]
"""(initial parameters, replay) -> parameters of the model fitted to the replay."""


def make_refit(model: Model, *, rounds: int = 6, iterations: int = 5) -> Refit:
    """Returns a refit by Levenberg-Marquardt in float64, one compiled program for all replays of one capacity.

    The refit evaluates the parameters after every round of iterations. It returns the parameters with the lowest error
    on held-out samples, or on fitted samples if none are held out.

    Args:
        model: model with parameters and energies in float64.
        iterations: Levenberg-Marquardt iterations per round.

    Raises:
        InputError: a number that is not positive, or a model that is not float64.
    """
    require_positive(rounds=rounds, iterations=iterations)

    def residual(parameters: Parameters, q: Array, qd: Array, qdd: Array, tau: Array, factor: Array) -> Array:
        return (dynamics(model.energies(parameters)).inverse_dynamics(q, qd, qdd) - tau) * factor

    @compiled
    def refit(parameters: Parameters, replay: Replay) -> Parameters:
        unit = _scale(replay)
        fitted, held_out = (jnp.sqrt(weight)[:, None] / unit for weight in (replay.fitted, replay.held_out))
        judged = jnp.where(jnp.sum(replay.held_out) > 0, held_out, fitted)
        samples = replay[:4]

        def one_round(carry: Any, number: Array) -> tuple[Any, None]:
            state, best = carry
            state = levenberg_marquardt.run(residual, state, (*samples, fitted), iterations)
            error = mean_square(partial(residual, state.parameters), (*samples, judged))
            return (state, better_of(best, state.parameters, error, number)), None

        start = levenberg_marquardt.init(parameters), no_best(parameters)
        numbers = jnp.arange(1, rounds + 1, dtype=jnp.int32)
        return jax.lax.scan(one_round, start, numbers)[0][1].parameters

    return refit


def make_linear_refit(model: Model) -> Refit:
    """Returns a refit by one least-squares problem on all samples, for a model that is linear in its parameters.

    Initial parameters are ignored. Undetermined combinations of parameters are zero (the shortest solution, see
    `solvers.least_squares`).

    Args:
        model: linear in its parameters, such as `make_planar_chain` or `make_rigid_tree`.
    """
    columns_of = design(model)

    def refit(parameters: Parameters, replay: Replay) -> Parameters:
        zero = jax.tree.map(jnp.zeros_like, parameters)
        columns, _ = columns_of(zero, *map(jnp.asarray, replay[:3]))
        used = np.asarray(replay.fitted + replay.held_out) > 0
        unit = np.asarray(_scale(replay))
        left = (np.asarray(columns)[used] / unit[:, None]).reshape(-1, np.shape(columns)[-1])
        right = (np.asarray(replay.tau)[used] / unit).ravel()
        return unravelled(least_squares.solve(left, right, negligible=1e-12).x, parameters)

    return refit


def _scale(replay: Replay) -> Float[Array, " d"]:
    """Returns the standard deviations of the joints' torques in the replay; 1 for a constant torque."""
    weight = replay.fitted + replay.held_out
    mean = jnp.average(replay.tau, axis=0, weights=weight)
    deviation = jnp.sqrt(jnp.average((replay.tau - mean) ** 2, axis=0, weights=weight))
    return jnp.where(deviation > 0, deviation, 1.0)


def learn_online(
    references: Iterable[Any],
    drive: Callable[[Parameters, Any], tuple[Any, tuple[Any, Any, Any, Any]]],
    refit: Refit,
    parameters: Parameters,
    replay: Replay,
) -> Iterator[tuple[Any, Parameters, Replay]]:
    """Alternates driving the robot along a reference and refitting the model to all samples so far.

    Yields, for each reference, the outcome with the previous model, and the parameters and replay after the refit.

    Args:
        references: references in order, passed to `drive`.
        drive: (parameters, reference) -> outcome, and the recorded q, qd, qdd and tau [n, d]; n may be zero.
        refit: result of `make_refit` or `make_linear_refit`.
        parameters: parameters for the first reference.
        replay: samples before the first reference, from `empty_replay`.

    Raises:
        InputError: `append_recording` refuses a recording.
    """
    for reference in references:
        outcome, recording = drive(parameters, reference)
        if len(recording[0]):
            replay = append_recording(replay, *recording)
            parameters = refit(parameters, replay)
        yield outcome, parameters, replay
