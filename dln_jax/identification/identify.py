"""Identification in one call: structural identifiability, a least-squares fit, physically consistent parameters, and a
report: base parameters, all parameters, and findings about the data."""

from typing import Any, NamedTuple, get_args

import numpy as np

from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.identification import equations
from dln_jax.identification.consistent import REGULARISATION, ConsistentFit, fit_consistent
from dln_jax.identification.equations import (
    BaseParameters,
    Columns,
    Determinacy,
    ParameterVector,
    columns_of,
    compress,
    flat,
    regressor_of,
)
from dln_jax.identification.weighted import ROUNDING, WeightedFit, correlation_times, fit_robust, fit_weighted
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, JointKind, JointVector

STATES = 40
"""Number of random states per joint for computing the structure."""
UNSEEN_SHARE = 0.02
"""Tolerance on the squared fraction of a parameter's identifiable part that the data miss: up to this fraction missed
counts as seen, and up to this fraction seen counts as missed."""
STILL = 0.01
"""rad or m: a joint whose range is smaller counts as motionless."""
LARGE_CONDITION = 300.0
"""Above this condition number, errors grow much more along some combinations than along others."""
LONG_CORRELATION = 10.0
"""Residuals with a longer correlation time, in samples, indicate model error rather than noise."""


class Identification(NamedTuple):
    """Result of an identification of P parameters."""

    columns: Columns
    known: ParameterVector
    """Prior values."""
    structure: tuple[Determinacy, ...]
    """Structural identifiability: how arbitrary motions could determine every parameter."""
    base: BaseParameters
    """Combinations that arbitrary motions could determine."""
    fit: WeightedFit
    """Least-squares fit to the data; its bodies may be physically inconsistent."""
    seen: tuple[Determinacy, ...]
    """How these data determine every parameter."""
    correlation: JointVector
    """Correlation time of every joint's residuals of `fit`, in samples."""
    consistent: ConsistentFit | None
    """Physically consistent parameters, if requested."""

    @property
    def theta(self) -> ParameterVector:
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
        model: such as `make_rigid_tree`.
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
    free = np.ones(len(theta))
    free[columns.bodies] = theta[columns.bodies].any(axis=1, keepdims=True)  # no links without mass
    at = known if at is None else at
    regressor, weights = regressor_of(model, at, data, free=free), None
    # The random states fill chunks of the same size as the data, so that both use one compiled program.
    samples = max(STATES * d, -(-len(data.t) // -(-len(data.t) // equations.CHUNK)))
    general = compress(regressor_of(model, at, random_states(joints, samples, 0), free=free))
    A = np.concatenate(general.triangles)[:, :-1]
    structure = equations.determinacy(A)
    base = equations.base_parameters(A, columns)
    if robust:
        rough, weights = fit_robust(regressor, theta)
        noise = rough.noise
    compact = compress(regressor, weights)
    fit = fit_weighted(compact, theta, noise=noise)
    correlation = correlation_times(equations.residuals(regressor, fit.theta), data.trajectory)
    fit = fit_weighted(compact, theta, noise=fit.noise, correlation=correlation)
    bodies = None
    if consistent:
        bodies = fit_consistent(equations.whiten(compact, fit.noise), columns, theta, regularisation=regularisation)
    return Identification(columns, theta, structure, base, fit, seen_by(fit, base, structure), correlation, bodies)


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
    return tuple(
        "not at all" if share > 1 - UNSEEN_SHARE
        else before if share < UNSEEN_SHARE or before == "not at all"
        else "in combination"
        for share, before in zip(shares.tolist(), structure, strict=True)
    )  # fmt: skip


def random_states(joints: tuple[JointKind, ...], samples: int, seed: int) -> Trajectories:
    """Random states: angles on the full circle, displacements up to 1 m, normal rates (sd 2), accelerations (sd 5)."""
    shape, random = (samples, len(joints)), np.random.default_rng(seed)
    reach = np.where(np.array(joints) == "revolute", np.pi, 1.0)
    q, qd, qdd = random.uniform(-reach, reach, shape), 2 * random.normal(size=shape), 5 * random.normal(size=shape)
    times = {"t": np.zeros(samples), "trajectory": np.arange(samples)}
    return from_arrays({**times, "q": q, "qd": qd, "qdd": qdd, "tau": np.ones(shape)})


def base_rows(result: Identification) -> list[dict[str, Any]]:
    """One row per base parameter: the combination, its fitted value, standard error and prior value."""
    combinations = result.base.combinations
    numbers = (combinations @ result.fit.theta, result.fit.standard_errors(combinations), combinations @ result.known)
    keys = ("combination", "value", "standard_error", "known")
    rows = zip(result.base.words, *(values.tolist() for values in numbers), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def parameter_rows(result: Identification) -> list[dict[str, Any]]:
    """One row per parameter: structure, what the data determine, values, and the standard error if there is one."""
    names = result.columns.names
    errors = result.fit.standard_errors(np.eye(len(names)))
    errors = [error if seen == "alone" else None for error, seen in zip(errors.tolist(), result.seen, strict=True)]
    numbers = (values.tolist() for values in (result.known, result.fit.theta))
    keys = ("name", "structure", "data", "known", "least_squares", "standard_error", "identified")
    rows = zip(names, result.structure, result.seen, *numbers, errors, result.theta.tolist(), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def lost(result: Identification) -> tuple[str, ...]:
    """Names of parameters that some motion could show, but these data do not."""
    return tuple(
        name
        for name, possible, seen in zip(result.columns.names, result.structure, result.seen, strict=True)
        if seen == "not at all" != possible
    )


def findings(result: Identification, data: Trajectories, names: tuple[str, ...]) -> list[str]:
    """Findings about the data, one line each with its remedy."""
    lines = []
    still = np.flatnonzero(np.ptp(data.q, axis=0) < STILL)
    if len(still):
        which = ", ".join(names[k] for k in still)
        lines.append(f"{which}: does not move; parameters that only its motion shows keep their values; record motions")
    if missing := lost(result):
        shown = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
        lines.append(f"determined by other motions, but not by these data: {shown}; vary speeds and postures more")
    if result.fit.condition > LARGE_CONDITION:
        lines.append(f"condition {result.fit.condition:.0f}: the motions are too similar; vary them more")
    times = result.correlation
    slow = np.flatnonzero(times > LONG_CORRELATION)
    if len(slow):
        which = ", ".join(f"{names[k]} {times[k]:.0f}" for k in slow)
        lines.append(
            f"residuals are correlated over many samples ({which}), by model errors (friction, elasticity) or a filter "
            "rather than noise; standard errors count such samples once"
        )
    rows = zip(result.columns.names, result.columns.kinds, result.fit.theta, strict=True)
    negative = [name for name, kind, value in rows if kind == "positive" and value < 0 and name not in missing]
    if negative and result.consistent is None:
        lines.append(f"negative friction or armature: {', '.join(negative)}; ask for physically consistent parameters")
    if result.consistent is not None and not result.consistent.converged:
        lines.append(
            f"the search for physically consistent bodies did not converge in {result.consistent.iterations} "
            "iterations; closer ones may exist"
        )
    return lines


def summary(result: Identification) -> list[str]:
    """How many parameters are identifiable, in two lines."""
    counts = ", ".join(f"{result.structure.count(kind)} {kind}" for kind in get_args(Determinacy))
    return [
        f"{len(result.structure)} parameters; motions determine {counts}: {len(result.base.words)} base parameters",
        f"these data determine {result.fit.rank} combinations, condition {result.fit.condition:.3g}",
    ]


def text(result: Identification) -> str:
    """The full report as plain text."""
    lines = [*summary(result), "", "base parameters: value ± standard error (before)"]
    for row in base_rows(result):
        lines.append(
            f"  {row['value']:12.5g} ± {row['standard_error']:<9.2g} ({row['known']:.5g})   {row['combination']}"
        )
    lines += ["", "parameter      motions could show  these data show   before       least squares          identified"]
    for row in parameter_rows(result):
        error = "" if row["standard_error"] is None else f"± {row['standard_error']:.2g}"
        lines.append(
            f"{row['name']:<14} {row['structure']:<19} {row['data']:<15} {row['known']:11.5g}  "
            f"{row['least_squares']:11.5g} {error:<10} {row['identified']:11.5g}"
        )
    return "\n".join(lines) + "\n"
