"""Fits a tree of unknown kinematics to states and torques: search, refinement, and a final linear problem."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import drawn
from dln_jax.learning.kinematics.frames import Frames
from dln_jax.learning.kinematics.projection import (
    Descent,
    Program,
    Samples,
    Structure,
    descend,
    design,
    inertias_of,
    make_program,
)
from dln_jax.learning.kinematics.search import ALIKE, Search, Twin, count_agreeing, difference, search
from dln_jax.learning.linear import design_chunks, weighted
from dln_jax.learning.objectives import torque_scale
from dln_jax.models.trees import SerialTreeParameters, make_serial_tree
from dln_jax.precision import compiled
from dln_jax.solvers import least_squares
from dln_jax.types import InputError, JointVector, Needs, require_positive

FINALISTS, NEAR = 3, 2.0
"""Largest number of local minima to refine and compare by validation, and their largest loss relative to the lowest."""
ROUNDS = 2
"""Rounds of reweighting the joints by unexplained torque; more rounds change the weights by a few per cent."""
CHUNK = 4096
"""Number of samples per chunk of columns in memory."""
LEAST_NOISE = 1e-7
"""Lower bound on the noise in a joint's weight, relative to its torque."""


class TreeFit(NamedTuple):
    """Tree fitted to torques, with errors and statistics of the search."""

    parameters: SerialTreeParameters
    """Parameters of `make_serial_tree`."""
    frames: Frames
    torque_mse: float
    """Mean over the fitted samples of the sum of squared errors over joints; (N m)² or N²."""
    joint_mse: JointVector
    """Mean squared error of every joint over the fitted samples, (N m)² or N²."""
    validation_error: float
    """`torque_mse` of the validation samples; NaN without any."""
    parameter_count: int
    """Number of parameters of frames (without gauges) and linear problem."""
    rank: int
    """Rank of the linear problem: combinations of inertias and friction that the data determine."""
    condition: float
    losses: Float[np.ndarray, " K"]
    """Final losses of all descents, lowest first: mean squares in units of the torques' standard deviations."""
    agreeing: int
    """Number of descents that ended at the lowest loss."""
    agreement: int
    """Number of agreeing descents that the search required (`Search.agreement`)."""
    twin: Twin | None
    """Comparison with another descent to the same loss, if there is one and it was requested."""
    seconds: float
    """Duration of the whole call, compilation included."""


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
    """Fits a tree's frames, inertias, armature and friction to measured torques, in float64.

    Gauss-Newton refines random frames on a subset of the samples and eliminates all other parameters (`projection`).
    The best frames are refined on all samples, with joints weighted by their unexplained torque. Validation chooses
    between local minima with losses within a factor of two. Handedness and other gauges (see `models.trees`) are
    arbitrary. The search continues until another descent to the same loss finds the same arm (`agreement`).

    Args:
        train: samples to fit, with accelerations.
        validation: samples that choose the local minimum (default: the training error chooses).
        parents: parent link of every link (default: a serial chain).
        acceleration: acceleration of gravity, m/s².
        velocity_scale: velocity scale of dry friction, 1/s or m/s.
        settings: starts, samples and limits of the search.
        ridge: ridge of the elimination, relative to the squared length of the columns.
        rank_tolerance: tolerance of the final linear problem, as in `solvers.least_squares.solve`.
        most_samples: largest number of samples for refining frames; the final linear problem uses all.
        report: takes lines about the search.

    Raises:
        InputError: constant torques, a different number of joints in the data, or a setting out of range.
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
        scale = torque_scale(train)
        program, columns = make_program(structure, ridge=ridge), _columns(structure)
        parts = [drawn(train, count, settings.seed) for count in (settings.samples, most_samples)]
        some, every = ((part.q, part.qd, part.qdd, part.tau) for part in parts)
        searched, twin, until, wanted = ([], 0), None, began + settings.seconds, settings

        def finished(descent: Descent) -> tuple[Descent, least_squares.LeastSquaresSolution, np.ndarray, np.ndarray]:
            """Returns the refined descent, its linear solution, and its mean squared errors by joint on both sets."""
            state, unit = _refine(program, structure, descent, every, scale, settings)
            rows = weighted(design_chunks(columns, state.frames, train, CHUNK), unit)
            solution = least_squares.solve_chunks(rows, rank_tolerance=rank_tolerance, negligible=1e-12)
            trained, judged = (
                _joint_errors(columns, state.frames, solution.x, part) for part in (train, validation or train)
            )
            return state, solution, trained, judged

        while True:
            searched = search(structure, program, some, scale, wanted, until=until, before=searched)
            descents, starts = searched
            lowest = float(descents[0].at.loss)
            report(f"{count_agreeing(descents)} of {len(descents)} starts reached the lowest loss, {lowest:.3g}")
            finalists = _finalists(descents, validation)
            candidates = [finished(descent) for descent in finalists]
            errors = [float(np.sum(judged / scale**2)) for *_, judged in candidates]
            chosen = int(np.argmin(errors))
            (state, solution, trained, judged), start = candidates[chosen], finalists[chosen]
            if not settings.confirm:
                break
            if others := [descent for descent in descents if descent is not start and _alike(descent, start)]:
                nearest = min(others, key=lambda other: difference(start.frames, other.frames, structure).size)
                other, *_, of_other = finished(nearest)
                relative = float(np.sum(of_other / scale**2)) / errors[chosen]
                twin = Twin(relative, difference(state.frames, other.frames, structure))
                report(f"The two best starts {twin.words}.")
            if (twin is not None and twin.same) or starts >= settings.starts or time.perf_counter() > until:
                break
            # Always run one more wave of starts.
            wanted = settings._replace(agreement=count_agreeing(descents) + 1)
        losses = np.array([float(descent.at.loss) for descent in descents])
        parameters = _parameters(structure, state.frames, solution.x)
    return TreeFit(
        parameters=parameters,
        frames=jax.tree.map(np.asarray, state.frames),
        torque_mse=float(trained.sum()),
        joint_mse=trained,
        validation_error=float("nan") if validation is None else float(judged.sum()),
        parameter_count=len(state.at.slope) + structure.linear_count,
        rank=solution.rank,
        condition=solution.condition,
        losses=losses,
        agreeing=count_agreeing(descents),
        agreement=settings.agreement,
        twin=twin,
        seconds=time.perf_counter() - began,
    )


def _alike(one: Descent, other: Descent) -> bool:
    """Whether two descents ended at the same loss."""
    low, high = sorted((float(one.at.loss), float(other.at.loss)))
    return high <= (1 + ALIKE) * low


def _finalists(descents: list[Descent], validation: Trajectories | None) -> list[Descent]:
    """Returns the lowest descent of each local minimum that validation may prefer."""
    kept = descents[:1]
    for descent in descents[1:]:
        loss, last = float(descent.at.loss), float(kept[-1].at.loss)
        near = loss <= NEAR * float(descents[0].at.loss)
        if validation is not None and near and loss > (1 + ALIKE) * last and len(kept) < FINALISTS:
            kept.append(descent)
    return kept


def _refine(
    program: Program,
    structure: Structure,
    state: Descent,
    samples: Samples,
    scale: JointVector,
    settings: Search,
) -> tuple[Descent, JointVector]:
    """Continues a descent on all samples, then with the residual torques of the joints as units."""
    unit = scale
    for last in range(ROUNDS + 1):
        state = descend(program, structure, state.frames, samples, unit, iterations=settings.iterations)
        if last < ROUNDS:
            unit = np.maximum(unit * np.sqrt(np.asarray(state.at.squares)), LEAST_NOISE * scale)
    return state, unit


def _joint_errors(columns: Callable, frames: Frames, linear: np.ndarray, data: Trajectories) -> JointVector:
    chunks = design_chunks(columns, frames, data, CHUNK)
    return np.sum([np.sum((Phi @ linear - tau) ** 2, axis=0) for Phi, _, tau in chunks], axis=0) / len(data.tau)


def _columns(structure: Structure) -> Callable:
    """Returns (frames, q, qd, qdd) -> Phi [N, d, P] and zeros [N, d], for `design_chunks`."""

    def one(frames: Frames, q: Array, qd: Array, qdd: Array) -> tuple[Array, Array]:
        return design(structure, frames, q, qd, qdd), jnp.zeros_like(q)

    return compiled(jax.vmap(one, in_axes=(None, 0, 0, 0)))


def _parameters(structure: Structure, frames: Frames, linear: np.ndarray) -> SerialTreeParameters:
    armature, *friction = linear[len(structure.inertial) :].reshape(-1, len(structure.joints))
    turns = Rotation.from_matrix(np.asarray(frames.rotations)).as_rotvec()
    inertias = inertias_of(structure, jnp.asarray(linear))
    parts = (turns, frames.positions, inertias, armature, *(friction or (None, None, None)))
    return SerialTreeParameters(*(None if part is None else jnp.asarray(part) for part in parts))
