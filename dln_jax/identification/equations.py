"""All that data say of a model linear in its parameters: one triangle for each joint, however many samples there are.

    |Phi_j theta - tau_j|² = |R_j (theta, -1)|²,   [Phi_j tau_j] = Q_j R_j

Weights of the joints, known parameters and other unknowns take operations on triangles [P + 1, P + 1], never the data.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.linear import design, design_chunks, require_linear, unravelled
from dln_jax.models.model import Model
from dln_jax.solvers.least_squares import triangular_factor
from dln_jax.types import InputError

CHUNK = 2048
"""Samples whose design matrix is in memory at a time."""


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


class Regressor(NamedTuple):
    """Phi and tau of data, as often as asked, without the memory for all of them."""

    passes: Callable[[], Iterator[tuple[np.ndarray, np.ndarray]]]
    """Phi [n, d, P] and tau [n, d] of n samples at a time."""
    samples: int
    joints: int
    unknowns: int


def regressor_of(
    model: Model,
    parameters: Any,
    data: Trajectories,
    *,
    free: np.ndarray | None = None,
    linearise: Callable | None = None,
) -> Regressor:
    """The equations of data, sample by sample.

    Args:
        model: linear in its parameters.
        parameters: of the model, at which it is differentiated, and its linearity is checked.
        data: with tau.
        free: columns [P] that are none where it is false, of parameters that are known to be zero.
        linearise: `learning.linear.design` of the model, where it is compiled already.

    Raises:
        InputError: data without torques, or as many joints as the model has not; passes raise it where the model turns
            out not to be linear.
    """
    if "tau" in data.estimated:
        raise InputError("the data have no tau; identification takes measured torques")
    theta = np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(parameters)])
    with jax.enable_x64(True):
        linearise = design(model) if linearise is None else linearise
        at = unravelled(theta, parameters)

    def passes() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        with jax.enable_x64(True):
            for columns, predicted, tau in design_chunks(linearise, at, data, CHUNK):
                require_linear(columns, theta, predicted)
                yield columns if free is None else columns * free, tau

    return Regressor(passes, len(data.tau), data.degrees_of_freedom, theta.size)


def compressed(regressor: Regressor, weights: Float[np.ndarray, "N d"] | None = None) -> Equations:
    """The equations as triangles, each row times the root of its weight where weights are given."""
    d, P = regressor.joints, regressor.unknowns
    triangles, first = np.zeros((d, P + 1, P + 1)), 0
    for columns, tau in regressor.passes():
        rows = np.concatenate([columns, tau[:, :, None]], axis=2)
        if weights is not None:
            rows = rows * np.sqrt(weights[first : first + len(tau), :, None])
        first += len(tau)
        for joint in range(d):
            stacked = np.concatenate([triangles[joint], rows[:, joint]])
            triangles[joint] = triangular_factor(stacked[:, :-1], stacked[:, -1])
    return Equations(triangles, regressor.samples)


def about(equations: Equations, theta: Float[np.ndarray, " P"]) -> Equations:
    """The equations of theta' - theta."""
    shifted = equations.triangles.copy()
    shifted[:, :, -1] -= equations.triangles[:, :, :-1] @ theta
    return equations._replace(triangles=shifted)


def weighted(equations: Equations, noise: Float[np.ndarray, " d"]) -> Float[np.ndarray, "K P_and_1"]:
    """One triangle of all joints, in units of their noise."""
    rows = (equations.triangles / noise[:, None, None]).reshape(-1, equations.unknowns + 1)
    return triangular_factor(rows[:, :-1], rows[:, -1])


def squares(equations: Equations, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, " d"]:
    """Sum over samples of squared residuals, of each joint."""
    rows = equations.triangles @ np.append(theta, -1.0)
    return np.sum(rows**2, axis=1)


def residuals(regressor: Regressor, theta: Float[np.ndarray, " P"]) -> Float[np.ndarray, "N d"]:
    """tau - Phi theta of every sample."""
    return np.concatenate([tau - columns @ theta for columns, tau in regressor.passes()])
