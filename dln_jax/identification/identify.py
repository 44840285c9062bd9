"""Identification from data in one call: what can be known, what these data say, and bodies that exist."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.identification import equations
from dln_jax.identification.base import (
    BaseParameters,
    Determinacy,
    base_parameters,
    determinacy,
    null_directions,
)
from dln_jax.identification.columns import Columns, columns_of, flat
from dln_jax.identification.consistent import REGULARISATION, ConsistentFit, fit_consistent
from dln_jax.identification.equations import compressed, regressor_of
from dln_jax.identification.robust import ResidualStatistics, fit_robust, residual_statistics
from dln_jax.identification.weighted import ROUNDING, WeightedFit, fit_weighted
from dln_jax.learning.linear import design, unravelled
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, JointKind

STATES = 40
"""Random states by joint, from which the structure is seen."""
UNSEEN_SHARE = 0.02
"""Of the part of a parameter that motions could show, squared: up to it data may miss what counts as seen, and what
counts as missed may they show."""


class Identification(NamedTuple):
    """What is known of P parameters."""

    columns: Columns
    known: Float[np.ndarray, " P"]
    """Values before."""
    structure: tuple[Determinacy, ...]
    """What any motion could determine of each parameter."""
    base: BaseParameters
    """Combinations that any motion could determine."""
    fit: WeightedFit
    """Least squares by these data; bodies need not exist."""
    seen: tuple[Determinacy, ...]
    """What these data determine of each parameter."""
    statistics: ResidualStatistics
    """Of the residuals of `fit`."""
    consistent: ConsistentFit | None
    """Bodies that exist, where asked for."""

    @property
    def theta(self) -> Float[np.ndarray, " P"]:
        """The consistent parameters, else those of least squares."""
        return self.fit.theta if self.consistent is None else self.consistent.theta


def identify(
    model: Model,
    known: Parameters,
    data: Trajectories,
    *,
    joints: tuple[JointKind, ...] | None = None,
    noise: Any = None,
    robust: bool = False,
    rank_tolerance: float | None = None,
    consistent: bool = True,
    regularisation: float = REGULARISATION,
    seed: int = 0,
) -> Identification:
    """Identifies the parameters of a model that is linear in them.

    Bodies without mass (links between the joints of one MJCF body) stay so.

    Args:
        model: such as `models.make_rigid_tree`.
        known: its parameters before, those of a file, at which what data do not show stays.
        data: with tau, for training; hold out what the result is judged by.
        joints: kinds, whose random states show the structure; by default all revolute.
        noise: standard deviation of the torque of each joint [d], N m or N; by default estimated.
        robust: errors beyond 1.345 times the noise count by their size and not by their square; noise is estimated.
        rank_tolerance: as for `fit_weighted`.
        consistent: find bodies that exist, too.
        regularisation: as for `fit_consistent`.
        seed: of the random states.

    Raises:
        InputError: data of another number of joints than the model's or without torques, a model that is not linear, or
            a setting out of range.
    """
    d = data.degrees_of_freedom
    joints = ("revolute",) * d if joints is None else joints
    if len(joints) != d:
        raise InputError(f"the data have {d} joints, the robot {len(joints)}; make them agree")
    if robust and noise is not None:
        raise InputError("noise is given, which a robust fit estimates; leave one of them out")
    columns, theta = columns_of(known), flat(known)
    free = _with_mass(columns, theta)
    linearise = design(model)
    # As many as data in a chunk, which is then one program.
    samples = max(STATES * d, -(-len(data.t) // -(-len(data.t) // equations.CHUNK)))
    states = random_states(joints, samples, seed)
    general = compressed(regressor_of(model, known, states, free=free, linearise=linearise))
    every = general.triangles.reshape(-1, general.unknowns + 1)[:, :-1]
    structure = determinacy(null_directions(every))
    regressor, weights = regressor_of(model, known, data, free=free, linearise=linearise), None
    if robust:
        rough, weights = fit_robust(regressor, theta, rank_tolerance=rank_tolerance)
        noise = rough.noise
    given = compressed(regressor, weights)
    fit = fit_weighted(given, theta, noise=noise, rank_tolerance=rank_tolerance)
    errors = equations.residuals(regressor, fit.theta)
    statistics = residual_statistics(errors, data.trajectory, fit.noise)
    fit = fit_weighted(given, theta, noise=fit.noise, correlation=statistics.correlation, rank_tolerance=rank_tolerance)
    base = base_parameters(every, columns)
    found = None
    if consistent:
        triangle = equations.weighted(given, fit.noise)
        found = fit_consistent(triangle, columns, theta, regularisation=regularisation)
    return Identification(
        columns,
        theta,
        structure,
        base,
        fit,
        seen_by(fit, base, structure),
        statistics,
        found,
    )


def seen_by(fit: WeightedFit, base: BaseParameters, structure: tuple[Determinacy, ...]) -> tuple[Determinacy, ...]:
    """What data show of each parameter, of what motions could."""
    scaled = base.combinations / np.where(fit.lengths > 0, fit.lengths, np.inf)
    lengths = np.linalg.norm(scaled, axis=1)
    _, sizes, right = np.linalg.svd(scaled[lengths > 0] / lengths[lengths > 0, None], full_matrices=False)
    possible = np.sum(right[sizes > ROUNDING * sizes.max(initial=0.0)] ** 2, axis=0)
    # Directions that data miss are those that no motion shows, and of the possible ones those that are lost.
    missed = np.sum(fit.unseen**2, axis=0) - (1 - possible)
    shown = possible > ROUNDING
    shares = np.where(shown, missed / np.where(shown, possible, 1.0), 1.0)

    def judged(share: float, before: Determinacy) -> Determinacy:
        if share > 1 - UNSEEN_SHARE:
            return "not at all"
        return before if share < UNSEEN_SHARE or before == "not at all" else "in combination"

    return tuple(judged(share, before) for share, before in zip(shares.tolist(), structure, strict=True))


def parameters_of(found: Float[np.ndarray, " P"], like: Parameters) -> Parameters:
    """Parameters of the model, of numbers in the order of its columns."""
    return jax.tree.map(jnp.asarray, unravelled(found, like))


def random_states(joints: tuple[JointKind, ...], samples: int, seed: int) -> Trajectories:
    """States anywhere: angles of the whole circle, a metre of displacement, rates and accelerations of some units."""
    d, random = len(joints), np.random.default_rng(seed)
    reach = np.where(np.array(joints) == "revolute", np.pi, 1.0)
    arrays = {
        "q": random.uniform(-reach, reach, (samples, d)),
        "qd": 2 * random.normal(size=(samples, d)),
        "qdd": 5 * random.normal(size=(samples, d)),
        "tau": np.ones((samples, d)),
    }
    return from_arrays({**arrays, "t": np.zeros(samples), "trajectory": np.arange(samples)})


def _with_mass(columns: Columns, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, " P"]:
    """1 for each column, 0 for those of links that have no mass."""
    free = np.ones(len(theta))
    inertial = np.flatnonzero(np.array(columns.kinds) == "inertia").reshape(-1, 10)
    free[inertial[~theta[inertial].any(axis=1)]] = 0.0
    return free
