"""Identification from data in one call: what can be known, what these data say, and bodies that exist."""

from typing import Any, NamedTuple

import jax
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
from dln_jax.identification.weighted import WeightedFit, fit_weighted
from dln_jax.learning.linear import unravelled
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, JointKind

STATES = 40
"""Random states by joint, from which the structure is seen."""
UNSEEN_SHARE = 0.1
"""Part of a parameter in directions that data do not show, up to which it counts as seen, and less that from all as
unseen."""


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
    training_squares: Float[np.ndarray, "2 d"]
    """Mean squared residuals of `fit` and of `consistent` (of `fit` again where there is none), (N m)² or N²."""

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
    held = _massless(columns, theta)
    regressor = regressor_of(model, known, data)
    general = compressed(regressor_of(model, known, random_states(joints, STATES * d, seed)))
    every = _without(general.triangles.reshape(-1, general.unknowns + 1)[:, :-1], held)
    structure = determinacy(null_directions(every))
    options: dict[str, Any] = {"held": held, "rank_tolerance": rank_tolerance}
    given = compressed(regressor)

    def fitted(correlation: np.ndarray | None) -> WeightedFit:
        if robust:
            return fit_robust(regressor, theta, correlation=correlation, **options)
        return fit_weighted(given, theta, noise=noise, correlation=correlation, **options)

    fit = fitted(None)
    errors = equations.residuals(regressor, fit.theta)
    statistics = residual_statistics(errors, data.trajectory, fit.noise)
    fit = fit._replace(covariance=fitted(statistics.correlation).covariance)
    found = None
    if consistent:
        bodies = fit_consistent(equations.weighted(given, fit.noise), columns, theta, regularisation=regularisation)
        found = bodies
    squares = [equations.squares(given, each) / given.samples for each in (fit.theta, (found or fit).theta)]
    seen = tuple(
        worse(*pair) for pair in zip(structure, determinacy(fit.unseen, tolerance=UNSEEN_SHARE), strict=True)
    )
    base = base_parameters(every, columns)
    return Identification(columns, theta, structure, base, fit, seen, statistics, found, np.array(squares))
