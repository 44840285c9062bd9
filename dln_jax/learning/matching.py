"""Derivative matching: fits a model to measured or estimated rates of its states.

    loss = mean over samples and components of |rates(q, p) - (qd, pd)|²           (phase fields)
    residual = (qdd_hat(q, qd, tau) - qdd) / spread of qdd                         (accelerations)

The first is the published loss of Hamiltonian networks (Greydanus, Dzamba and Yosinski 2019). Gauss-Newton or Adam
minimise it, or one least-squares problem for a field that is linear in its parameters. Validation trajectories, drawn
from the training set, select the parameters; no test data are used. If states are noisy and rates are not, the loss has
a bias that more data do not remove: it flattens the field (regression dilution).

The second works with or without torques. This fit is enough for exact accelerations. Otherwise it is the first fit for
`learning.shooting`, which does not depend on estimated derivatives.
"""

import functools
import math
import time

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select_samples
from dln_jax.learning.engine.problem import Problem, Progress, Stop, Training, arrays_of, selected_by
from dln_jax.learning.linear import shapes_of
from dln_jax.learning.objectives import TORQUE
from dln_jax.learning.shooting import Gauge, check_gauge, gauge_error
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers import least_squares
from dln_jax.types import SampleVector, require_positive, require_seed

PHASE = ("q", "p", "qd", "pd")


def rate_residual(model: Model, parameters: Parameters, q: Array, p: Array, qd: Array, pd: Array) -> Array:
    """Returns (rates - (qd, pd)) / sqrt(2 d) of one sample [2 d]; its sum of squares is the sample's loss."""
    velocity, force = flow(model.energies(parameters)).rates(q, p)
    return jnp.concatenate([velocity - qd, force - pd]) / math.sqrt(2 * q.shape[0])


def rates_problem(
    model: Model, train: Trajectories, validation: Trajectories, *, seed: int = 0, most_samples: int = 10_000
) -> Problem:
    """Builds the problem of fitting a model to the rates of trajectories, in the precision of the model.

    Args:
        model: a phase model.
        train: trajectories with p and pd.
        validation: trajectories that select the parameters, with p and pd, for example from `data.splits.hold_out`.
        seed: seed for the initial parameters, the drawn samples and their order.
        most_samples: largest number of samples for training and for validation; larger sets are drawn at random.

    Raises:
        InputError: p or pd is missing, squares overflow, or a setting is out of range.
    """
    require_positive(most_samples=most_samples)
    require_seed(seed)
    parameters = jax.jit(model.init)(jax.random.key(seed))
    dtype = jnp.result_type(*jax.tree.leaves(parameters))

    def drawn(part: Trajectories) -> tuple[Array, ...]:
        rows = np.random.default_rng(seed).permutation(len(part.t))[:most_samples]
        return arrays_of(select_samples(part, rows), PHASE, dtype)

    fitted, held_out = map(drawn, (train, validation))
    return selected_by(held_out, functools.partial(rate_residual, model), parameters, fitted, seed)


def match_linear(
    model: Model, data: Trajectories, *, validation: Trajectories | None = None
) -> tuple[Training, SampleVector]:
    """Fits a field that is linear in its parameters by least squares, in float64; also returns the validation errors.

    These are squared errors of the validation samples, or of the training samples without validation.

    Raises:
        InputError: p or pd is missing, or numbers or their squares are not finite.
    """
    began = time.perf_counter()
    with jax.enable_x64(True):
        zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes_of(model))
        columns = jax.jit(jax.jacrev(lambda c, *sample: rate_residual(model, c, *sample)))
        arrays = arrays_of(data, PHASE)
        design = np.asarray(jax.jit(jax.vmap(columns, in_axes=(None, 0, 0, 0, 0)))(zero, *arrays))
        target = -np.asarray(jax.jit(jax.vmap(functools.partial(rate_residual, model, zero)))(*arrays))
        solution = least_squares.solve(design.reshape(-1, design.shape[-1]), target.ravel())
        seconds = time.perf_counter() - began
        judged = arrays if validation is None else arrays_of(validation, PHASE)
        errors = jax.vmap(functools.partial(rate_residual, model, jnp.asarray(solution.x)))(*judged)
        squares = np.sum(np.asarray(errors) ** 2, axis=1)
    fitted = solution.residual**2 / len(arrays[0])
    at = Progress(1, fitted, float(squares.mean()), float("nan"), seconds)
    return Training(jnp.asarray(solution.x), [at], Stop("finished", 1), 1, 0.0), squares


def accelerations_problem(
    model: Model,
    parameters: Parameters,
    data: Trajectories,
    validation: Trajectories,
    *,
    gauge: Gauge | None = None,
    most_samples: int = 4_000,
    seed: int = 0,
) -> Problem:
    """Builds the problem of fitting a model to accelerations, in float64.

    Args:
        model: any model of energies or accelerations, with float64 parameters.
        data: training samples; at most `most_samples` of them are drawn at random.
        validation: samples that select the parameters.
        gauge: fixes the scale of the energies; needed only for motions without torques.
        seed: seed for the draw and the sample order.

    Raises:
        InputError: both torques and gauge are missing, or numbers are too large.
    """
    require_positive(most_samples=most_samples)
    check_gauge(gauge, data.tau, data.degrees_of_freedom)
    size = spread("qdd", data.qdd)
    scale = jnp.asarray(np.where(size > 0, size, 1.0))

    def error(parameters: Parameters, q: Array, qd: Array, qdd: Array, tau: Array) -> Array:
        return (dynamics(model.energies(parameters)).forward_dynamics(q, qd, tau) - qdd) / scale

    def residual(parameters: Parameters, *sample: Array) -> Array:
        return jnp.append(error(parameters, *sample), gauge_error(dynamics(model.energies(parameters)), gauge))

    def drawn(part: Trajectories) -> tuple[Array, ...]:
        samples = len(part.t)
        if samples > most_samples:
            rows = np.random.default_rng(seed).choice(samples, size=most_samples, replace=False)
            part = select_samples(part, np.sort(rows))
        return arrays_of(part, TORQUE.keys)

    fitted, held_out = map(drawn, (data, validation))
    return selected_by(held_out, residual, parameters, fitted, seed, error=error)
