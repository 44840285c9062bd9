"""Least-squares equations of a linear model, names of their columns, and base parameters.

One triangular factor per joint represents the equations:

    |Phi_j theta - tau_j|² = |R_j (theta, -1)|²,   [Phi_j tau_j] = Q_j R_j

Reweighting joints, fixing parameters and changing unknowns then act on the [P + 1, P + 1] factors, not on the data.

The columns follow from the model's parameters. The leaf `inertias` [links, 10] has the inertial parameters of the
bodies, and each leaf of `coupling` has one entry of the motors' armature matrix. Every other leaf has one entry per
joint and gives its name to its columns, so a new friction law needs no change here.

Base parameters show which parameters are identifiable alone, which only in combination, and which not at all. Forces
depend on P parameters through fewer combinations, the base parameters (Gautier and Khalil 1990; numerically Gautier
1991). The columns are visited in an order of preference. A column that is linearly independent of earlier ones goes to
Phi_1. The others are Phi_2 = Phi_1 K, so that Phi theta = Phi_1 (theta_1 + K theta_2). Bodies nearer to the ground come
first. Within a body, mass, h_z and I_yy come last, since they are usually regrouped.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.learning.linear import design, design_chunks, require_linear, unravelled
from dln_jax.learning.posterior import Rows
from dln_jax.mechanics.trees.inertia import PARAMETERS
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers.least_squares import scaled_columns
from dln_jax.types import InputError, JointSamples, JointVector

ParameterVector = Float[np.ndarray, " P"]
Kind = Literal["inertia", "positive", "signed", "coupling"]
Determinacy = Literal["alone", "in combination", "not at all"]
PREFERRED = ("I_zz", "h_x", "h_y", "I_xx", "I_xy", "I_xz", "I_yz", "I_yy", "h_z", "m")
"""The ten parameters of a body, in their stored order."""
DEPENDENT = 1e-8
"""Columns whose residual after projection on the others is shorter than this fraction of their length count as linearly
dependent; so do singular values below this fraction of the largest. For random states this lies well between rounding
errors and true residuals."""
NEGLIGIBLE = 1e-12
"""Columns shorter than this fraction of the longest count as zero, because their terms cancel up to rounding."""
SHARE = 1e-6
"""A parameter is identifiable alone if its share in the undetermined directions is smaller."""
SHOWN = 1e-7
"""Coefficients below this fraction of the largest in their combination are rounding errors and set to zero."""
BODIES, MOTORS, COUPLING = "inertias", "armature", "coupling_"
"""Leaves with the inertial parameters (ten columns per body) and the motors' inertias, and prefix of columns for
off-diagonal entries of the armature, such as "coupling_2_3"."""
SIGNED = ("offset",)
"""Endings of leaf names with entries of either sign."""
CHUNK = 2048
"""Number of samples per chunk of the design matrix in memory."""


class Columns(NamedTuple):
    """Columns of P parameters in the order of the model's leaves."""

    names: tuple[str, ...]
    """Names such as "I_xx_3" or "viscous_2", joints counted from 1."""
    kinds: tuple[Kind, ...]
    """"inertia" for the ten columns of a body, "positive" for armature and friction, "signed" for either sign,
    "coupling" for the armature between two motors."""

    @property
    def bodies(self) -> Int[np.ndarray, "bodies 10"]:
        """The ten columns of each body."""
        return np.flatnonzero(np.array(self.kinds) == "inertia").reshape(-1, 10)

    @property
    def motors(self) -> Int[np.ndarray, "n n"]:
        """Columns for the entries of the coupled motors' armature matrix; -1 for zero entries."""
        columns = {name: column for column, name in enumerate(self.names)}
        coupled = [map(int, name.removeprefix(COUPLING).split("_")) for name in columns if name.startswith(COUPLING)]
        motors = sorted({motor for pair in coupled for motor in pair})
        entries = np.full((len(motors),) * 2, -1)
        for i, j in np.ndindex(entries.shape):
            low, high = sorted((motors[i], motors[j]))
            entries[i, j] = columns.get(f"{MOTORS}_{low}" if i == j else f"{COUPLING}{low}_{high}", -1)
        return entries


def columns_of(parameters: Parameters) -> Columns:
    """Returns the columns of a model with these parameters; leaf and index name the columns outside `inertias`."""
    rows: list[tuple[str, Kind]] = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(parameters):
        name = jax.tree_util.keystr(path, simple=True, separator="_")
        kind: Kind = "signed" if name.endswith(SIGNED) else "positive"
        own = [f"{name}_{joint + 1}" for joint in range(np.size(leaf))]
        if name.startswith(COUPLING):
            kind, own = "coupling", [name]
        elif name == BODIES and np.shape(leaf)[1:] == (len(PARAMETERS),):
            kind, own = "inertia", [f"{which}_{joint + 1}" for joint in range(len(leaf)) for which in PARAMETERS]
        rows.extend((column, kind) for column in own)
    return Columns(*zip(*rows, strict=True))


def flat(parameters: Parameters) -> ParameterVector:
    """Concatenates all parameters in the order of the columns."""
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(parameters)]).astype(float)


class Equations(NamedTuple):
    """Compressed equations of N samples of d joints."""

    triangles: Float[np.ndarray, "d K P_and_1"]
    """[Phi_j tau_j] = Q_j R_j."""
    samples: int
    """N."""


Regressor = Callable[[], Rows]
"""Starts a new pass over the equations, which yields Phi [n, d, P] and tau [n, d] in chunks of n samples."""


def regressor_of(
    model: Model,
    parameters: Parameters,
    data: Trajectories,
    *,
    free: np.ndarray | None = None,
) -> Regressor:
    """Makes the regressor of a dataset.

    Args:
        model: a model that is linear in its parameters.
        parameters: point for the derivative and the check of linearity.
        data: samples with tau.
        free: [P]; zero for parameters known to be zero, which sets their columns to zero.

    Raises:
        InputError: the data have no torques. A pass raises it if the model is not linear.
    """
    if "tau" in data.estimated:
        raise InputError("the data have no tau; identification needs measured torques")
    theta = flat(parameters)
    with jax.enable_x64(True):
        at = unravelled(theta, parameters)

    def passes() -> Rows:
        with jax.enable_x64(True):
            for columns, predicted, tau in design_chunks(design(model), at, data, CHUNK):
                require_linear(columns, theta, predicted)
                yield columns if free is None else columns * free, tau

    return passes


def compress(regressor: Regressor, weights: JointSamples | None = None) -> Equations:
    """Compresses the equations to triangular factors, with rows scaled by the square root of `weights`, if any."""
    triangles, samples = None, 0
    for columns, tau in regressor():
        rows = np.concatenate([columns, tau[:, :, None]], axis=2)
        if weights is not None:
            rows = rows * np.sqrt(weights[samples : samples + len(tau), :, None])
        samples += len(tau)
        rows = rows.swapaxes(0, 1)
        triangles = np.linalg.qr(rows if triangles is None else np.concatenate([triangles, rows], axis=1), mode="r")
    if triangles is None:
        raise InputError("there are no equations; expected at least one sample")
    return Equations(triangles, samples)


def whiten(equations: Equations, noise: JointVector) -> Float[np.ndarray, "K P_and_1"]:
    """Combines the triangular factors of all joints, with rows in units of the joint's noise."""
    return np.linalg.qr(np.concatenate(equations.triangles / noise[:, None, None]), mode="r")


def squares(equations: Equations, theta: ParameterVector) -> JointVector:
    """Returns the sum of squared residuals over the samples, per joint."""
    return np.sum((equations.triangles @ np.append(theta, -1.0)) ** 2, axis=1)


def residuals(regressor: Regressor, theta: ParameterVector) -> JointSamples:
    """Returns tau - Phi theta of each sample."""
    return np.concatenate([tau - columns @ theta for columns, tau in regressor()])


class BaseParameters(NamedTuple):
    """B identifiable combinations of P parameters."""

    combinations: Float[np.ndarray, "B P"]
    """beta = combinations theta; each row has a 1 in its independent column."""
    independent: tuple[int, ...]
    """Independent column of each combination."""
    words: tuple[str, ...]
    """Combinations as text, such as "I_xx_3 + 0.3 m_4"."""


def base_parameters(A: Float[np.ndarray, "N P"], columns: Columns) -> BaseParameters:
    """Finds the base parameters from the triangular factor of the columns in their order of preference.

    Args:
        A: Phi at more generic states than parameters, or its triangular factor.
        columns: names and kinds of the columns.
    """
    preferred = columns.bodies[:, [PARAMETERS.index(name) for name in PREFERRED]]
    order = np.append(preferred, np.flatnonzero(np.array(columns.kinds) != "inertia"))
    scaled, lengths = scaled_columns(A, NEGLIGIBLE)
    remainders = np.diagonal(np.linalg.qr(scaled[:, order], mode="r"))
    independent = np.sort(order[abs(remainders) > DEPENDENT]).tolist()
    # Solve with columns of unit length, then scale back.
    factors = np.linalg.lstsq(scaled[:, independent], scaled, rcond=None)[0]
    combinations = factors * lengths / lengths[independent][:, None]
    combinations[abs(factors) < SHOWN * abs(factors).max(axis=1, initial=0.0)[:, None]] = 0.0
    combinations[:, independent] = np.eye(len(independent))
    words = tuple(in_words(row, columns.names, column) for row, column in zip(combinations, independent, strict=True))
    return BaseParameters(combinations, tuple(independent), words)


def in_words(combination: ParameterVector, names: Sequence[str], first: int) -> str:
    """Writes a combination as a sum, starting with the column of factor 1."""
    others = np.flatnonzero(combination)
    text = names[first]
    for column in others[others != first]:
        factor = combination[column]
        size = "" if abs(abs(factor) - 1) < SHOWN else f"{abs(factor):.4g} "
        text += f" {'-' if factor < 0 else '+'} {size}{names[column]}"
    return text


def determinacy(A: Float[np.ndarray, "N P"]) -> tuple[Determinacy, ...]:
    """Classifies each parameter as identifiable alone, in combination or not at all.

    Args:
        A: as for `null_directions`.
    """
    shares = np.linalg.norm(null_directions(A), axis=0)
    return tuple("alone" if s < SHARE else "not at all" if s > 1 - SHARE else "in combination" for s in shares)


def null_directions(A: Float[np.ndarray, "N P"]) -> Float[np.ndarray, "K P"]:
    """Returns orthonormal directions that the equations do not determine, for columns scaled to unit length.

    Each column of zeros has its own direction.

    Args:
        A: Phi, or its triangular factor.
    """
    _, sizes, right = np.linalg.svd(np.linalg.qr(scaled_columns(A, NEGLIGIBLE)[0], mode="r"))
    return right[int(np.sum(sizes > DEPENDENT * sizes.max(initial=0.0))) :]
