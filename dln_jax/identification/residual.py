"""A small residual network on top of an identified tree, no larger than held-out motions justify.

The parameters of the tree are frozen. The candidates grow from no network at all. One replaces another only if its
error on validation motions is lower by more than the standard error of the difference. That error is computed over
segments of time assumed to be independent, since neighbouring samples are not.
"""

import math
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.data.splits import select as trajectories
from dln_jax.learning import dynamics
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.objectives import SCALED_TORQUE, arrays, residuals, squared_torque_errors
from dln_jax.learning.select import Trial, mean_of_segments, select
from dln_jax.models.model import Model, Parameters
from dln_jax.models.residual import ResidualParameters, frozen, make_residual, make_with_residual
from dln_jax.types import InputError, Needs, ResidualTerm


class Candidate(NamedTuple):
    """Size of a network; no terms means no network."""

    terms: tuple[ResidualTerm, ...] = ()
    width: int = 0


CANDIDATES = (
    Candidate(),
    Candidate(("dissipation",), 4),
    Candidate(("potential", "dissipation"), 4),
    Candidate(("potential", "dissipation"), 8),
    Candidate(("potential", "dissipation", "inertia"), 8),
    Candidate(("potential", "dissipation"), 16),
)


def inner_split(train: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training data without every fourth trajectory or block, and those, to choose the size of a network by."""
    present = np.unique(train.trajectory)
    if len(present) < 2:
        raise InputError("a part to choose by takes two trajectories or blocks to fit; record more motions")
    return trajectories(train, np.setdiff1d(present, present[1::4])), trajectories(train, present[1::4])


class ResidualFit(NamedTuple):
    """The tree with the selected residual network, if any."""

    model: Model
    """The tree's own model, or the sum."""
    parameters: Parameters
    """Parameters of the tree, or `ResidualParameters`."""
    chosen: Candidate
    settings: dict[str, Any]
    """Keywords of `make_residual`; empty if no network was selected."""
    trials: list[Trial]
    """All candidates tried, with errors per segment of validation motion in units of the torque's spread."""


def fit_residual(
    rigid: Model,
    parameters: Parameters,
    needs: Needs,
    train: Trajectories,
    validation: Trajectories,
    *,
    candidates: tuple[Candidate, ...] = CANDIDATES,
    iterations: int = 40,
    seconds: float = math.inf,
) -> ResidualFit:
    """Fits residual networks to the torques unexplained by an identified tree, and selects the smallest sufficient one.

    Args:
        rigid: such as `models.make_rigid_tree`.
        parameters: identified parameters, which stay fixed.
        train: data that the tree was identified from.
        validation: other motions, used for selection; judge the result on yet others.
        candidates: candidates in order of size, the first without terms.
        iterations: upper limit of Gauss-Newton iterations; the parameters with the lowest validation error are kept.
        seconds: time limit; then the current network stops training, and no other one is tried.

    Raises:
        InputError: the first candidate has terms, or the torques do not vary.
    """
    if not candidates or candidates[0].terms:
        raise InputError("candidates start with a network; the first must be none, which the others have to improve on")
    until = time.perf_counter() + seconds
    with jax.enable_x64(True):
        scale = np.asarray(SCALED_TORQUE.scale(train))
        batch = arrays(SCALED_TORQUE, train, jnp.float64)
        unexplained = jax.jit(lambda: residuals(SCALED_TORQUE, rigid.energies(parameters), batch))()
        magnitudes = {"torque_scale": unexplained, "rate_scale": train.qd, "acceleration_scale": train.qdd}
        sizes = {
            name: tuple(float(f"{size:.3g}") if size > 0 else 1.0 for size in spread(name, np.asarray(values)))
            for name, values in magnitudes.items()
        }

        def errors(model: Model, parameters: Parameters) -> Float[np.ndarray, " segments"]:
            squares = squared_torque_errors(model, parameters, validation, scale)
            return mean_of_segments(validation, np.sum(squares, axis=1))

        def attempt(candidate: Candidate) -> tuple[Any, Float[np.ndarray, " segments"]]:
            if not candidate.terms:
                return None, errors(rigid, parameters)
            settings = {**candidate._asdict(), **sizes}
            both = make_with_residual(rigid, make_residual(needs, **settings))
            problem = dynamics.problem(frozen(both, parameters), Split(train, validation, validation), SCALED_TORQUE)
            training = fit(problem, GaussNewton(steps=iterations), seconds=max(until - time.perf_counter(), 1e-9))
            whole = ResidualParameters(parameters, training.parameters)
            return (both, whole, settings), errors(both, whole)

        chosen, trials = select(candidates, attempt, patience=2, until=until)
    model, whole, settings = (rigid, parameters, {}) if chosen.outcome is None else chosen.outcome
    return ResidualFit(model, whole, chosen.candidate, settings, trials)
