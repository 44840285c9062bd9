"""Identification in one call: structural identifiability, a least-squares fit and physically consistent parameters."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.identification import equations
from dln_jax.identification.base import BaseParameters, Determinacy, base_parameters, determinacy, null_directions
from dln_jax.identification.consistent import REGULARISATION, ConsistentFit, fit_consistent
from dln_jax.identification.equations import Columns, columns_of, compress, flat, regressor_of
from dln_jax.identification.weighted import (
    ROUNDING,
    WeightedFit,
    correlation_times,
    fit_robust,
    fit_weighted,
)
from dln_jax.learning.linear import unravelled
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, JointKind

STATES = 40
"""Number of random states per joint for computing the structure."""
UNSEEN_SHARE = 0.02
"""Tolerance on the squared fraction of a parameter's identifiable part that the data miss: up to this fraction missed
counts as seen, and up to this fraction seen counts as missed."""


class Identification(NamedTuple):
    """Result of an identification of P parameters."""

    columns: Columns
    known: Float[np.ndarray, " P"]
    """Prior values."""
    structure: tuple[Determinacy, ...]
    """Structural identifiability: how arbitrary motions could determine every parameter."""
    base: BaseParameters
    """Combinations that arbitrary motions could determine."""
    fit: WeightedFit
    """Least-squares fit to the data; its bodies may be physically inconsistent."""
    seen: tuple[Determinacy, ...]
    """How these data determine every parameter."""
    correlation: Float[np.ndarray, " d"]
    """Correlation time of every joint's residuals of `fit`, in samples."""
    consistent: ConsistentFit | None
    """Physically consistent parameters, if requested."""

    @property
    def theta(self) -> Float[np.ndarray, " P"]:
        """The physically consistent parameters if computed, otherwise those of least squares."""
        return self.fit.theta if self.consistent is None else self.consistent.theta


def identify(
    model: Model,
    known: Parameters,
    data: Trajectories,
    *,
    joints: tuple[JointKind, ...] | None = None,
    at: Parameters | None = None,
    noise: Any = None,
    robust: bool = False,
    consistent: bool = True,
    regularisation: float = REGULARISATION,
) -> Identification:
    """Identifies the parameters of a model that is linear in them.

    Bodies without mass (links between the joints of one MJCF body) stay massless.

    Args:
        model: such as `models.make_rigid_tree`.
        known: prior parameters, such as those of a robot file; directions that the data do not determine keep them.
        data: training data with tau; hold out other motions to judge the result.
        joints: kinds of the joints, for drawing the random states; all revolute by default.
        at: parameters at which the model is linearised, for friction by load, whose forces are linear as long as the
            links' torques keep their signs: those of `learning.friction.fit_friction`.
        noise: standard deviation of the torque of each joint [d], N m or N; estimated by default.
        robust: use Huber's loss, which grows linearly beyond 1.345 times the noise; the noise is then estimated.
        consistent: also fit physically consistent parameters.
        regularisation: as for `fit_consistent`.

    Raises:
        InputError: no torques, numbers of joints that differ, a model that is not linear, or a setting out of range.
    """
    d = data.degrees_of_freedom
    joints = ("revolute",) * d if joints is None else joints
    if len(joints) != d:
        raise InputError(f"the data have {d} joints, the robot {len(joints)}; make them agree")
    if robust and noise is not None:
        raise InputError("noise is given, which a robust fit estimates; leave one of them out")
    columns, theta = columns_of(known), flat(known)
    massless = ~theta[columns.bodies].any(axis=1)
    free = np.ones(len(theta))
    free[columns.bodies[massless]] = 0.0
    at = known if at is None else at
    regressor, weights = regressor_of(model, at, data, free=free), None
    # The random states fill chunks of the same size as the data, so that both use one compiled program.
    samples = max(STATES * d, -(-len(data.t) // -(-len(data.t) // equations.CHUNK)))
    states = random_states(joints, samples, 0)
    general = compress(regressor_of(model, at, states, free=free))
    A = general.triangles.reshape(-1, general.unknowns + 1)[:, :-1]
    structure, base = determinacy(null_directions(A)), base_parameters(A, columns)
    if robust:
        rough, weights = fit_robust(regressor, theta)
        noise = rough.noise
    compact = compress(regressor, weights)
    fit = fit_weighted(compact, theta, noise=noise)
    correlation = correlation_times(equations.residuals(regressor, fit.theta), data.trajectory)
    fit = fit_weighted(compact, theta, noise=fit.noise, correlation=correlation)
    bodies = None
    if consistent:
        triangle = equations.whiten(compact, fit.noise)
        bodies = fit_consistent(triangle, columns, theta, regularisation=regularisation)
    seen = seen_by(fit, base, structure)
    return Identification(columns, theta, structure, base, fit, seen, correlation, bodies)


def seen_by(fit: WeightedFit, base: BaseParameters, structure: tuple[Determinacy, ...]) -> tuple[Determinacy, ...]:
    """Classifies how the data determine every parameter, relative to what motions could determine."""
    scaled = base.combinations / np.where(fit.lengths > 0, fit.lengths, np.inf)
    lengths = np.linalg.norm(scaled, axis=1)
    _, sizes, right = np.linalg.svd(scaled[lengths > 0] / lengths[lengths > 0, None], full_matrices=False)
    possible = np.sum(right[sizes > ROUNDING * sizes.max(initial=0.0)] ** 2, axis=0)
    # `unseen` holds the structurally unidentifiable directions, subtracted here, and those that the data miss.
    missed = np.sum(fit.unseen**2, axis=0) - (1 - possible)
    shown = possible > ROUNDING
    shares = np.where(shown, missed / np.where(shown, possible, 1.0), 1.0)

    def judged(share: float, before: Determinacy) -> Determinacy:
        if share > 1 - UNSEEN_SHARE:
            return "not at all"
        return before if share < UNSEEN_SHARE or before == "not at all" else "in combination"

    return tuple(judged(share, before) for share, before in zip(shares.tolist(), structure, strict=True))


def parameters_of(theta: Float[np.ndarray, " P"], like: Parameters) -> Parameters:
    """Parameters of the model from a vector in the order of its columns."""
    return jax.tree.map(jnp.asarray, unravelled(theta, like))


def random_states(joints: tuple[JointKind, ...], samples: int, seed: int) -> Trajectories:
    """Random states: angles on the full circle, displacements up to 1 m, normal rates (sd 2), accelerations (sd 5)."""
    d, random = len(joints), np.random.default_rng(seed)
    reach = np.where(np.array(joints) == "revolute", np.pi, 1.0)
    arrays = {
        "q": random.uniform(-reach, reach, (samples, d)),
        "qd": 2 * random.normal(size=(samples, d)),
        "qdd": 5 * random.normal(size=(samples, d)),
        "tau": np.ones((samples, d)),
    }
    return from_arrays({**arrays, "t": np.zeros(samples), "trajectory": np.arange(samples)})
