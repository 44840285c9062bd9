"""Fitting a tree of unknown kinematics to states and torques: search, refinement, and one last linear problem."""

import functools
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import drawn
from dln_jax.learning.kinematics.descent import Program, State, compiled, descend
from dln_jax.learning.kinematics.frames import Frames
from dln_jax.learning.kinematics.projection import Samples, Structure, design, inertias_of
from dln_jax.learning.kinematics.search import ALIKE, Search, agreeing, search
from dln_jax.learning.objectives import torque_scale
from dln_jax.models.serial_tree import SerialTreeParameters, make_serial_tree, rotation_vector
from dln_jax.solvers import least_squares
from dln_jax.types import InputError, Needs, require_positive

FINALISTS, NEAR = 3, 2.0
"""Valleys that are refined and judged by validation: at most so many, whose losses are at most so many times the
lowest."""
ROUNDS = 2
"""Of weighting each joint by what its torques leave unexplained, after which weights change by percents."""
LEAST_NOISE = 1e-7
"""Relative to the torque: no joint is weighted as if it were measured better."""


class TreeFit(NamedTuple):
    """A tree that explains torques, and how it was found."""

    parameters: SerialTreeParameters
    """Of `make_serial_tree`."""
    frames: Frames
    torque_mse: float
    """Mean over the fitted samples of the sum of squared errors over joints; (N m)² or N²."""
    joint_mse: Float[np.ndarray, " d"]
    """(N m)² or N², mean over the fitted samples."""
    validation_error: float
    """As `torque_mse`, of the validation samples; NaN without any."""
    parameter_count: int
    """Numbers of the frames that are no gauges, and of the linear problem."""
    rank: int
    """Of the linear problem: combinations of inertias and friction that the data determine."""
    condition: float
    losses: Float[np.ndarray, " K"]
    """Ends of all descents, mean squares in units of each torque's standard deviation, lowest first."""
    agreeing: int
    """Descents that ended as low as the lowest."""
    agreement: int
    """Descents that the search wanted to agree (`Search.agreement`)."""
    seconds: float
    """Of the whole call, compilation included."""


def fit_tree(
    needs: Needs,
    train: Trajectories,
    validation: Trajectories | None = None,
    *,
    parents: Sequence[int] | None = None,
    acceleration: float = 9.81,
    velocity_scale: float = 0.01,
    settings: Search = Search(),  # noqa: B008
    ridge: float = 1e-10,
    rank_tolerance: float = 1e-9,
    most_samples: int = 4000,
    report: Callable[[str], None] = lambda text: None,
) -> TreeFit:
    """The frames, inertias, armature and friction with which a tree explains torques, computed in float64.

    Random frames are refined by Gauss-Newton, all else eliminated (`projection`), on some samples; the best also on
    all, each joint then weighted by its own unexplained torque. Its valleys within a factor of two are chosen from by
    validation. Handedness and other gauges (see `models.serial_tree`) are as they happen to come.

    Args:
        needs: kinds of joints, gravity, friction.
        train: to fit to; accelerations count.
        validation: to choose by; without it the training error does.
        parents: link that each hangs on; by default one after the other.
        acceleration: of gravity, m/s².
        velocity_scale: of dry friction, 1/s or m/s.
        settings: how much is tried.
        ridge: of the elimination, relative to the squared length of each column.
        rank_tolerance: of the last linear problem, as in `solvers.least_squares.solve`.
        most_samples: that frames are refined on; the last linear problem has all.
        report: is told what was found, a line at a time.

    Raises:
        InputError: torques that do not vary, other joints than the data's, or a setting out of range.
    """
    require_positive(ridge=ridge, most_samples=most_samples, samples=settings.samples)
    if needs.degrees_of_freedom != train.degrees_of_freedom:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, the data {train.degrees_of_freedom}")
    # The model's factory checks the rest.
    make_serial_tree(needs, parents=parents, acceleration=acceleration, velocity_scale=velocity_scale)
    began = time.perf_counter()
    d = needs.degrees_of_freedom
    order = tuple(range(-1, d - 1)) if parents is None else tuple(parents)
    acceleration = acceleration if needs.gravity else 0.0
    structure = Structure(order, needs.joints, acceleration, needs.friction, velocity_scale)
    with jax.enable_x64(True):
        scale = np.asarray(torque_scale(train))
        program = compiled(structure, ridge=ridge)
        found = search(structure, program, _some(train, settings.samples, settings.seed), scale, settings)
        lowest = float(found[0].at.loss)
        report(f"{len(found)} descents, {agreeing(found)} of them to the lowest loss, {lowest:.3g}")
        every = _some(train, most_samples, settings.seed)
        refined = [_refined(program, structure, each, every, scale, settings) for each in _finalists(found, validation)]
        columns = _columns(structure)
        solved = [_solved(columns, state, unit, train, rank_tolerance) for state, unit in refined]
        pairs = [(state.frames, solution.x) for (state, _), solution in zip(refined, solved, strict=True)]
        errors = [_joint_errors(columns, *pair, train) for pair in pairs]
        judged = [_joint_errors(columns, *pair, validation or train) for pair in pairs]
        best = int(np.argmin([np.sum(each / scale**2) for each in judged]))
        (frames, linear), solution = pairs[best], solved[best]
        parameters = _parameters(structure, frames, linear)
    return TreeFit(
        parameters=parameters,
        frames=jax.tree.map(np.asarray, frames),
        torque_mse=float(errors[best].sum()),
        joint_mse=errors[best],
        validation_error=float("nan") if validation is None else float(judged[best].sum()),
        parameter_count=len(refined[best][0].at.slope) + structure.linear_count,
        rank=solution.rank,
        condition=solution.condition,
        losses=np.array([float(each.at.loss) for each in found]),
        agreeing=agreeing(found),
        agreement=settings.agreement,
        seconds=time.perf_counter() - began,
    )


def _some(data: Trajectories, most: int, seed: int) -> Samples:
    """All samples, or so many that are drawn."""
    some = drawn(data, most, seed)
    return Samples(some.q, some.qd, some.qdd, some.tau)


def _finalists(found: list[State], validation: Trajectories | None) -> list[State]:
    """The lowest of each valley that validation may prefer to the lowest of all."""
    kept = found[:1]
    for state in found[1:]:
        loss, last = float(state.at.loss), float(kept[-1].at.loss)
        near = loss <= NEAR * float(found[0].at.loss)
        if validation is not None and near and loss > (1 + ALIKE) * last and len(kept) < FINALISTS:
            kept.append(state)
    return kept


def _refined(
    program: Program,
    structure: Structure,
    state: State,
    samples: Samples,
    scale: Float[np.ndarray, " d"],
    settings: Search,
) -> tuple[State, Float[np.ndarray, " d"]]:
    """The descent carried on with all samples, and then with units of the torque that each joint leaves over."""
    unit = scale
    for last in range(ROUNDS + 1):
        state = descend(program, structure, state.frames, samples, unit, iterations=settings.iterations)
        if last < ROUNDS:
            unit = np.maximum(unit * np.sqrt(np.asarray(state.at.squares)), LEAST_NOISE * scale)
    return state, unit


def _solved(
    columns: Callable, state: State, unit: Float[np.ndarray, " d"], data: Trajectories, rank_tolerance: float
) -> least_squares.Solution:
    """The linear parameters of given frames from all data, by singular values."""

    def equations() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for Phi, tau in _designs(columns, state.frames, data):
            yield (Phi / unit[:, None]).reshape(-1, Phi.shape[-1]), (tau / unit).ravel()

    return least_squares.solve_chunks(equations(), rank_tolerance=rank_tolerance, negligible=1e-12)


def _joint_errors(columns: Callable, frames: Frames, linear: np.ndarray, data: Trajectories) -> Float[np.ndarray, " d"]:
    """Mean squared error of each joint's torque."""
    squares = [np.sum((Phi @ linear - tau) ** 2, axis=0) for Phi, tau in _designs(columns, frames, data)]
    return np.sum(squares, axis=0) / len(data.tau)


def _columns(structure: Structure) -> Callable:
    """(frames, q, qd, qdd) -> Phi [N, d, P]."""
    batched = jax.vmap(functools.partial(design, structure), in_axes=(None, 0, 0, 0))
    return jax.jit(batched, compiler_options=quick_compilation())


def _designs(
    columns: Callable, frames: Frames, data: Trajectories, *, length: int = 4096
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Phi [n, d, P] and tau [n, d] of so many samples at a time."""
    for first in range(0, len(data.tau), length):
        rows = slice(first, first + length)
        yield np.asarray(columns(frames, data.q[rows], data.qd[rows], data.qdd[rows])), data.tau[rows]


def _parameters(structure: Structure, frames: Frames, linear: np.ndarray) -> SerialTreeParameters:
    """Of the model."""
    armature, *friction = linear[len(structure.inertial) :].reshape(-1, len(structure.joints))
    turns = np.array([rotation_vector(each) for each in np.asarray(frames.rotations)])
    inertias = inertias_of(structure, jnp.asarray(linear))
    parts = (turns, frames.positions, inertias, armature, *(friction or (None, None, None)))
    return SerialTreeParameters(*(None if part is None else jnp.asarray(part) for part in parts))
