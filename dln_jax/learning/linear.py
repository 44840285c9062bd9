"""Fits models that are linear in their parameters by one least-squares problem, without iteration.

    tau = Phi(q, qd, qdd) theta,   theta minimises sum over samples of |(Phi theta - tau) / torque_scale|²

This works for any `Model` with linear parameters, such as `models.trigonometric`. Phi is the derivative of the inverse
model with respect to the parameters, which is exact for a linear model.

`choose_degrees` selects the size of a trigonometric basis. A common degree for all joints grows until it no longer
helps (`learning.select`). If that degree exceeds 1, each joint in turn takes the smallest degree that is not
significantly worse. A joint that neither changes the mass matrix nor lifts a weight, such as an arm's first vertical
axis, ends at degree 0, which divides the size of the basis by 2 n + 1.
"""

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.schema import Trajectories
from dln_jax.learning.objectives import squared_torque_errors, torque_scale
from dln_jax.learning.posterior import Rows
from dln_jax.learning.select import Selection, Trial, select, significantly_better
from dln_jax.models.model import Model, Parameters, linearised
from dln_jax.precision import compiled
from dln_jax.solvers import least_squares
from dln_jax.solvers.normal_equations import count
from dln_jax.types import InputError, JointVector, Needs, SampleVector, require_positive
from dln_jax.zoo.descriptions import make

LARGEST_DEGREE = 4
MOST_PARAMETERS = 1_500
"""Largest number of parameters of a basis; a fit takes about N d P² operations."""
ROUNDING = 1e-10
"""Bases with a smaller error, relative to the torque, count as equally good."""
# Largest rounding difference between the model's force and Phi theta, relative to the sum of absolute terms.
_LINEARITY_TOLERANCE = 1e-9
_NOT_LINEAR = "the model's torque is not linear in its parameters; use make_trigonometric, or train this model with fit"


class LinearFit(NamedTuple):
    """Identified parameters, with rank, condition and error of the fit."""

    parameters: Any
    """Parameters of the model, in its dtype."""
    parameter_count: int
    """P, the number of parameters."""
    rank: int
    """Number of parameter combinations that the data determine; the solution is zero in the other P - rank."""
    condition: float
    """Condition number of the scaled columns within the rank: the largest amplification of relative errors in the
    data."""
    torque_mse: float
    """Mean over the fitted samples of the sum of squared errors over joints, in float64; (N m)² or N²."""
    seconds: float
    """Duration of the whole call, compilation included."""


def fit_linear(
    model: Model,
    data: Trajectories,
    *,
    ridge: float = 0.0,
    rank_tolerance: float | None = None,
    negligible: float = 0.0,
    chunk_size: int = 4096,
) -> LinearFit:
    """Fits the parameters that minimise the torque error on the data; computes in float64 for any dtype of the model.

    The fit takes about N d P² operations. If the data leave combinations of parameters undetermined, the result is the
    shortest solution (see `solvers.least_squares`), which predicts the same forces for similar motions.

    Args:
        model: linear in its parameters.
        data: trajectories to fit; hold out trajectories for the evaluation.
        ridge: dimensionless, as in `solvers.least_squares.solve`.
        rank_tolerance: as in `solvers.least_squares.solve` (default: rounding).
        negligible: as in `solvers.least_squares.solve`; 1e-12 for rigid trees, where some columns are rounding.
        chunk_size: number of samples per chunk of the design matrix in memory.

    Raises:
        InputError: the model is not linear in its parameters, the torques are constant, or a setting is out of range.
    """
    require_positive(chunk_size=chunk_size)
    start = time.perf_counter()
    like = shapes_of(model)
    with jax.enable_x64(True):
        scale = torque_scale(data)
        zero = np.zeros(count(like))
        linearise = design(model)  # one program for both passes

        solution = least_squares.solve_chunks(
            weighted(design_chunks(linearise, unravelled(zero, like), data, chunk_size), scale),
            ridge=ridge,
            rank_tolerance=rank_tolerance,
            negligible=negligible,
        )
        parameters = unravelled(solution.x, like)
        parts = (
            (predicted - tau, require_linear(columns, solution.x, predicted))
            for columns, predicted, tau in design_chunks(linearise, parameters, data, chunk_size)
        )
        errors, rounding = map(np.concatenate, zip(*parts, strict=True))
        # A nonlinear but homogeneous force passes the test per sample; only its total residual differs.
        if not abs(np.linalg.norm(errors / scale) - solution.residual) <= np.linalg.norm(rounding / scale):
            raise InputError(_NOT_LINEAR)
    return LinearFit(
        parameters=parameters_of(solution.x, like),
        parameter_count=zero.size,
        rank=solution.rank,
        condition=solution.condition,
        torque_mse=float(np.mean(np.sum(errors**2, axis=1))),
        seconds=time.perf_counter() - start,
    )


@functools.lru_cache(maxsize=4)
def design(model: Model) -> Callable:
    """Returns the compiled (parameters, q, qd, qdd as [N, d]) -> Phi [N, d, P] and tau [N, d]."""
    one = functools.partial(linearised, model)
    return compiled(jax.vmap(one, in_axes=(None, 0, 0, 0)))


def require_linear(columns: np.ndarray, theta: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Returns the rounding bound between Phi theta and the force; `InputError` if they differ by more."""
    rounding = _LINEARITY_TOLERANCE * (abs(columns) @ abs(theta))
    if not (abs(columns @ theta - predicted) <= rounding).all():
        raise InputError(_NOT_LINEAR)
    return rounding


def shapes_of(model: Model) -> Parameters:
    """Returns the shapes and dtypes of a model's parameters."""
    return jax.eval_shape(model.init, jax.random.key(0))


def unravelled(vector: np.ndarray | Array, like: Parameters) -> Parameters:
    """Converts a vector to a tree like another, in the order of its leaves, without compilation."""
    leaves, structure = jax.tree.flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = (vector[end - leaf.size : end].reshape(leaf.shape) for leaf, end in zip(leaves, ends, strict=True))
    return jax.tree.unflatten(structure, parts)


def parameters_of(vector: np.ndarray, like: Parameters) -> Parameters:
    """Converts a vector to parameters with the structure and dtypes of others."""
    return jax.tree.map(lambda leaf, other: jnp.asarray(leaf, other.dtype), unravelled(vector, like), like)


def design_chunks(
    linearise: Callable, parameters: Parameters, data: Trajectories, chunk_size: int, *, even: bool = True
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yields Phi [n, d, P], the model's tau and the measured tau [n, d] for chunks of n <= chunk_size samples.

    Even chunks waste no work; chunks of exactly `chunk_size` samples share one program for any number of samples.
    """
    samples = len(data.tau)
    length = -(-samples // -(-samples // chunk_size)) if even else chunk_size
    for first in range(0, samples, length):
        # The last chunk is padded with its first sample, so that one program serves all chunks.
        last = min(first + length, samples)
        rows = np.append(np.arange(first, last), np.full(first + length - last, first))
        columns, tau = linearise(parameters, data.q[rows], data.qd[rows], data.qdd[rows])
        yield np.asarray(columns)[: last - first], np.asarray(tau)[: last - first], data.tau[first:last]


def weighted(chunks: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]], unit: JointVector) -> Rows:
    """Yields rows [n d, P] and right-hand sides [n d] from `design_chunks`, in units of the joints."""
    for columns, _, tau in chunks:
        yield (columns / unit[:, None]).reshape(-1, columns.shape[2]), (tau / unit).ravel()


def choose_degrees(needs: Needs, train: Trajectories, validation: Trajectories) -> Selection:
    """Chooses the degree of every joint; returns the chosen trial and all trials.

    The candidate of a `Trial` is the degrees, and its outcome the `LinearFit` in float64. Its errors are squared torque
    errors of the validation samples in units of the joints' `torque_scale`, summed over joints. Degrees above 1 have at
    most `MOST_PARAMETERS` parameters, and no more parameters than the training data have equations.

    Raises:
        InputError: the basis of degree 1 is too large, or `fit_linear` refuses the data.
    """
    d = needs.degrees_of_freedom
    scale = torque_scale(train)
    target = ROUNDING**2 * float(np.mean(np.sum((validation.tau / scale) ** 2, axis=1)))

    def fit(degrees: tuple[int, ...]) -> tuple[LinearFit, SampleVector]:
        with jax.enable_x64(True):
            model = make("trigonometric", needs, degree=degrees)
            solution = fit_linear(model, train)
        errors = squared_torque_errors(model, solution.parameters, validation, scale)
        return solution, np.sum(errors, axis=1)

    def fits(degree: int) -> bool:
        size = parameters_of_degree(needs, degree)
        return size is not None and size <= min(MOST_PARAMETERS, train.tau.size)

    degrees = 1, *itertools.takewhile(fits, range(2, LARGEST_DEGREE + 1))
    chosen, trials = select([(n,) * d for n in degrees], fit, patience=1, stop=lambda trial: trial.validation <= target)
    for joint in range(d if chosen.candidate[0] > 1 else 0):
        while chosen.candidate[joint] > 0:
            fewer = tuple(n - (place == joint) for place, n in enumerate(chosen.candidate))
            trials.append(Trial(fewer, *fit(fewer)))
            if trials[-1].validation > target and significantly_better(chosen.errors, trials[-1].errors):
                break
            chosen = trials[-1]
    return chosen, trials


def parameters_of_degree(needs: Needs, degree: int) -> int | None:
    """Counts the parameters of the trigonometric model with this degree in every joint; `None` if too many."""
    try:
        model = make("trigonometric", needs, degree=degree)
    except InputError:
        return None
    return count(shapes_of(model))
