"""Least-squares equations of a model linear in its parameters, and the names of their columns.

The equations are compressed to one triangular factor per joint:

    |Phi_j theta - tau_j|² = |R_j (theta, -1)|²,   [Phi_j tau_j] = Q_j R_j

Reweighting joints, fixing parameters and changing unknowns then act on the [P + 1, P + 1] factors, not on the data.

The columns follow from the model's parameters. The leaf `inertias` [links, 10] holds the inertial parameters of the
bodies, the leaves of `coupling` one entry of the motors' armature matrix each; every other leaf has one entry per joint
and gives its name to its columns. A new friction law therefore needs no change here.
"""

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.schema import Trajectories
from dln_jax.learning.linear import design, design_chunks, require_linear, unravelled
from dln_jax.mechanics.trees.inertia import PARAMETERS
from dln_jax.models.model import Model, Parameters
from dln_jax.solvers.least_squares import triangular_factor
from dln_jax.types import InputError

Kind = Literal["inertia", "positive", "signed", "coupling"]
BODIES, MOTORS, COUPLING = "inertias", "armature", "coupling_"
"""Names of the leaves with the inertial parameters, ten columns per body, and with the motors' inertias; start of the
names of columns off the diagonal of the armature, such as "coupling_2_3"."""
SIGNED = ("offset",)
"""Endings of the names of leaves whose entries may have either sign."""
CHUNK = 2048
"""Number of samples whose design matrix is in memory at a time."""


class Columns(NamedTuple):
    """Columns of P parameters in the order of the model's leaves."""

    names: tuple[str, ...]
    """Names such as "I_xx_3" or "viscous_2", joints counted from 1."""
    kinds: tuple[Kind, ...]
    """"inertia" for the ten columns of a body, "positive" for armature and friction, "signed" for either sign,
    "coupling" for the armature between two motors."""
    joints: tuple[int, ...]
    """Joint of every column, counted from 0, the second one of a coupling."""

    @property
    def bodies(self) -> Int[np.ndarray, "bodies 10"]:
        """The ten columns of every body."""
        return np.flatnonzero(np.array(self.kinds) == "inertia").reshape(-1, 10)

    @property
    def motors(self) -> list[tuple[int, int, int]]:
        """(column, motor, motor) of every entry of the armature matrix of the coupled motors."""
        entries: list[tuple[int, int, int]] = []
        for column in np.flatnonzero(np.array(self.kinds) == "coupling").tolist():
            first, second = self.names[column].removeprefix(COUPLING).split("_")
            entries.append((column, int(first) - 1, int(second) - 1))
        coupled = sorted({motor for _, *both in entries for motor in both})
        return entries + [(self.names.index(f"{MOTORS}_{motor + 1}"), motor, motor) for motor in coupled]


def columns_of(parameters: Parameters) -> Columns:
    """Columns of a model with these parameters; outside `inertias` a column is named by its leaf and place in it."""
    names: list[str] = []
    kinds: list[Kind] = []
    joints: list[int] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = "_".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
        shape = np.shape(leaf)
        bodies = name == BODIES and len(shape) == 2 and shape[1] == len(PARAMETERS)
        kind: Kind = "inertia" if bodies else "signed" if name.endswith(SIGNED) else "positive"
        if name.startswith(COUPLING):
            names, kinds, joints = [*names, name], [*kinds, "coupling"], [*joints, int(name.rpartition("_")[2]) - 1]
            continue
        for place in range(int(np.prod(shape))):
            joint, which = divmod(place, len(PARAMETERS)) if bodies else (place, 0)
            names.append(f"{PARAMETERS[which] if bodies else name}_{joint + 1}")
            kinds.append(kind)
            joints.append(joint)
    return Columns(tuple(names), tuple(kinds), tuple(joints))


def flat(parameters: Parameters) -> Float[np.ndarray, " P"]:
    """Concatenates all parameters in the order of the columns."""
    leaves: list[Any] = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(parameters)]
    return np.concatenate(leaves)


class Equations(NamedTuple):
    """Compressed equations of N samples of d joints."""

    triangles: Float[np.ndarray, "d K P_and_1"]
    """[Phi_j tau_j] = Q_j R_j."""
    samples: int
    """N."""

    @property
    def unknowns(self) -> int:
        """P."""
        return self.triangles.shape[2] - 1


Regressor = Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]
"""Starts a pass over the equations: yields Phi [n, d, P] and tau [n, d] of n samples at a time, computed anew."""


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
        parameters: point where the model is differentiated and its linearity checked.
        data: samples with tau.
        free: [P]; columns where it is zero are set to zero, for parameters known to be zero.

    Raises:
        InputError: the data have no torques. A pass raises it if the model turns out not to be linear.
    """
    if "tau" in data.estimated:
        raise InputError("the data have no tau; identification takes measured torques")
    theta = flat(parameters)
    with jax.enable_x64(True):
        at = unravelled(theta, parameters)

    def passes() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        with jax.enable_x64(True):
            for columns, predicted, tau in design_chunks(design(model), at, data, CHUNK):
                require_linear(columns, theta, predicted)
                yield columns if free is None else columns * free, tau

    return passes


def compress(regressor: Regressor, weights: Float[np.ndarray, "N d"] | None = None) -> Equations:
    """Compresses the equations to triangular factors, with rows scaled by the square root of `weights`, if any."""
    triangles, first = np.zeros((0, 0, 0)), 0
    for columns, tau in regressor():
        rows = np.concatenate([columns, tau[:, :, None]], axis=2)
        if weights is not None:
            rows = rows * np.sqrt(weights[first : first + len(tau), :, None])
        if not first:
            triangles = np.zeros((rows.shape[1], rows.shape[2], rows.shape[2]))
        first += len(tau)
        for joint, factor in enumerate(triangles):
            stacked = np.concatenate([factor, rows[:, joint]])
            triangles[joint] = triangular_factor(stacked[:, :-1], stacked[:, -1])
    return Equations(triangles, first)


def about(equations: Equations, theta: Float[np.ndarray, " P"]) -> Equations:
    """The equations for theta' - theta as the unknown."""
    shifted = equations.triangles.copy()
    shifted[:, :, -1] -= equations.triangles[:, :, :-1] @ theta
    return equations._replace(triangles=shifted)


def whiten(equations: Equations, noise: Float[np.ndarray, " d"]) -> Float[np.ndarray, "K P_and_1"]:
    """One triangular factor of all joints, with rows in units of the joint's noise."""
    rows = (equations.triangles / noise[:, None, None]).reshape(-1, equations.unknowns + 1)
    return triangular_factor(rows[:, :-1], rows[:, -1])


def squares(equations: Equations, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, " d"]:
    """Sum of squared residuals over the samples, per joint."""
    rows = equations.triangles @ np.append(theta, -1.0)
    return np.sum(rows**2, axis=1)


def residuals(regressor: Regressor, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, "N d"]:
    """tau - Phi theta of every sample."""
    return np.concatenate([tau - columns @ theta for columns, tau in regressor()])
