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
"""Tolerance on the squared fraction of a parameter's identifiable part that the data miss. Data that miss less see the
parameter; data that see less miss it."""
STILL = 0.01
"""rad or m: a joint with a smaller range is motionless."""
LARGE_CONDITION = 300.0
"""Condition number above which errors differ strongly between combinations."""
LONG_CORRELATION = 10.0
"""Correlation time of residuals, in samples, above which they are model errors rather than noise."""


class Identification(NamedTuple):
    """Result of an identification of P parameters."""

    columns: Columns
    known: ParameterVector
    """Prior values."""
    structure: tuple[Determinacy, ...]
    """Structural identifiability of each parameter, by arbitrary motions."""
    base: BaseParameters
    """Combinations that arbitrary motions can determine."""
    fit: WeightedFit
    """Least-squares fit to the data; its bodies may be physically inconsistent."""
    seen: tuple[Determinacy, ...]
    """Identifiability of each parameter by these data."""
    correlation: JointVector
    """Correlation time of each joint's residuals of `fit`, in samples."""
    consistent: ConsistentFit | None
    """Physically consistent parameters, if requested."""

    @property
    def theta(self) -> ParameterVector:
        """The physically consistent parameters if computed, otherwise the least-squares parameters."""
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
        model: a linear model, for example from `make_rigid_tree`.
        known: prior parameters, for example from a robot file; undetermined directions keep them.
        data: training data with tau; hold out other motions for the evaluation.
        joints: kinds of the joints, for drawing random states (default: all revolute).
        at: parameters for linearising friction by load, from `learning.friction.fit_friction`; its forces are linear as
            long as the links' torques keep their signs.
        noise: standard deviation of each joint's torque noise [d], N m or N (default: estimated).
        robust: use Huber's loss, which grows linearly beyond 1.345 times the noise; the noise is then estimated.
        consistent: also fit physically consistent parameters.
        regularisation: as for `fit_consistent`.

    Raises:
        InputError: torques are missing, numbers of joints differ, the model is not linear, or a setting is out of
            range.
    """
    d = data.degrees_of_freedom
    joints = ("revolute",) * d if joints is None else joints
    if len(joints) != d:
        raise InputError(f"the data have {d} joints, the robot {len(joints)}; make them agree")
    if robust and noise is not None:
        raise InputError("a robust fit estimates the noise itself; leave out noise or robust")
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
    """Classifies the identifiability of each parameter by the data, relative to arbitrary motions."""
    scaled = base.combinations / np.where(fit.lengths > 0, fit.lengths, np.inf)
    lengths = np.linalg.norm(scaled, axis=1)
    _, sizes, right = np.linalg.svd(scaled[lengths > 0] / lengths[lengths > 0, None], full_matrices=False)
    possible = np.sum(right[sizes > ROUNDING * sizes.max(initial=0.0)] ** 2, axis=0)
    # `unseen` has structurally unidentifiable directions, subtracted here, and directions that the data miss.
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
    """Draws random states: full-circle angles, displacements up to 1 m, normal rates (sd 2) and accelerations (sd
    5)."""
    shape, random = (samples, len(joints)), np.random.default_rng(seed)
    reach = np.where(np.array(joints) == "revolute", np.pi, 1.0)
    q, qd, qdd = random.uniform(-reach, reach, shape), 2 * random.normal(size=shape), 5 * random.normal(size=shape)
    times = {"t": np.zeros(samples), "trajectory": np.arange(samples)}
    return from_arrays({**times, "q": q, "qd": qd, "qdd": qdd, "tau": np.ones(shape)})


def base_rows(result: Identification) -> list[dict[str, Any]]:
    """Returns a row per base parameter: combination, fitted value, standard error and prior value."""
    combinations = result.base.combinations
    numbers = (combinations @ result.fit.theta, result.fit.standard_errors(combinations), combinations @ result.known)
    keys = ("combination", "value", "standard_error", "known")
    rows = zip(result.base.words, *(values.tolist() for values in numbers), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def parameter_rows(result: Identification) -> list[dict[str, Any]]:
    """Returns a row per parameter: identifiability by any motion and by the data, values, and any standard error."""
    names = result.columns.names
    errors = result.fit.standard_errors(np.eye(len(names)))
    errors = [error if seen == "alone" else None for error, seen in zip(errors.tolist(), result.seen, strict=True)]
    numbers = (values.tolist() for values in (result.known, result.fit.theta))
    keys = ("name", "structure", "data", "known", "least_squares", "standard_error", "identified")
    rows = zip(names, result.structure, result.seen, *numbers, errors, result.theta.tolist(), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def lost(result: Identification) -> tuple[str, ...]:
    """Returns the names of parameters that other motions can determine, but these data do not."""
    return tuple(
        name
        for name, possible, seen in zip(result.columns.names, result.structure, result.seen, strict=True)
        if seen == "not at all" != possible
    )


def findings(result: Identification, data: Trajectories, names: tuple[str, ...]) -> list[str]:
    """Returns findings about the data, one line each with a remedy."""
    lines = []
    still = np.flatnonzero(np.ptp(data.q, axis=0) < STILL)
    if len(still):
        which = ", ".join(names[k] for k in still)
        lines.append(f"{which}: does not move, so parameters that need its motion keep their values; record motions")
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
        lines.append(f"negative friction or armature: {', '.join(negative)}; fit physically consistent parameters")
    if result.consistent is not None and not result.consistent.converged:
        lines.append(
            f"the search for physically consistent bodies did not converge in {result.consistent.iterations} "
            "iterations; closer ones may exist"
        )
    return lines


def summary(result: Identification) -> list[str]:
    """Returns two lines with the number of identifiable parameters."""
    counts = ", ".join(f"{result.structure.count(kind)} {kind}" for kind in get_args(Determinacy))
    return [
        f"{len(result.structure)} parameters; motions determine {counts}: {len(result.base.words)} base parameters",
        f"these data determine {result.fit.rank} combinations, condition {result.fit.condition:.3g}",
    ]


def text(result: Identification) -> str:
    """Returns the full report as plain text."""
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
