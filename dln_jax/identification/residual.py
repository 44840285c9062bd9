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

from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import dynamics
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.model_selection import Trial, grow, segments
from dln_jax.learning.objectives import SCALED_TORQUE, arrays, residuals
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
    seed: int = 0,
) -> ResidualFit:
    """Fits residual networks to the torques unexplained by an identified tree, and selects the smallest sufficient one.

    Args:
        rigid: such as `models.make_rigid_tree`.
        parameters: identified parameters, which stay fixed.
        needs: kinds of the joints.
        train: data from which the tree was identified.
        validation: other motions, used for selection; judge the result on yet others.
        candidates: candidates in order of size, the first without terms.
        iterations: upper limit of Gauss-Newton iterations; the parameters with the lowest validation error are kept.
        seconds: time limit, after which the current network stops training and no other one is tried.
        seed: seed of the networks.

    Raises:
        InputError: the first candidate has terms, or the torques do not vary.
    """
    if not candidates or candidates[0].terms:
        raise InputError("candidates start with a network; expected none at all first, which others have to better")
    began = time.perf_counter()
    with jax.enable_x64(True):
        scale = SCALED_TORQUE.scale(train)
        segment = segments(validation)
        of_train, of_validation = (arrays(SCALED_TORQUE, data, jnp.float64) for data in (train, validation))
        judge = jax.jit(lambda system_of, batch: residuals(SCALED_TORQUE, system_of(), batch) / scale, static_argnums=0)
        left = np.asarray(judge(lambda: rigid.energies(parameters), of_train)) * np.asarray(scale)
        sizes = _sizes(train, left)
        sets = Split(train, validation, validation)

        def errors(system_of: Any) -> Float[np.ndarray, " segments"]:
            squares = np.sum(np.asarray(judge(system_of, of_validation)) ** 2, axis=1)
            return np.bincount(segment, squares) / np.bincount(segment)

        def attempt(candidate: Candidate) -> tuple[Any, Float[np.ndarray, " segments"]]:
            if not candidate.terms:
                return None, errors(lambda: rigid.energies(parameters))
            time_left = began + seconds - time.perf_counter()
            if time_left <= 0:
                return None, np.full(segment.max() + 1, np.inf)
            settings = {"terms": candidate.terms, "width": candidate.width, **sizes}
            both = make_with_residual(rigid, make_residual(needs, **settings))
            part = frozen(both, parameters)
            training = fit(
                dynamics.problem(part, sets, SCALED_TORQUE, seeds=seed),
                GaussNewton(steps=iterations),
                seconds=time_left,
            )
            found = ResidualParameters(parameters, training.parameters)
            return (both, found, settings), errors(lambda: both.energies(found))

        chosen, trials = grow(candidates, attempt)
    if chosen.outcome is None:
        return ResidualFit(rigid, parameters, chosen.candidate, {}, trials)
    model, found, settings = chosen.outcome
    return ResidualFit(model, found, chosen.candidate, settings, trials)


def _sizes(train: Trajectories, left: Float[np.ndarray, "N d"]) -> dict[str, tuple[float, ...]]:
    """Typical magnitudes, to three digits, of unexplained torques, rates and accelerations."""
    named = {"torque_scale": left, "rate_scale": train.qd, "acceleration_scale": train.qdd}
    return {
        name: tuple(float(f"{size:.3g}") if size > 0 else 1.0 for size in spread(name, numbers))
        for name, numbers in named.items()
    }
