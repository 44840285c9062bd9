"""Identifies the friction and the inertias of a rigid tree: linear coefficients directly, curve shapes by Gauss-Newton.

    tau = Phi(q, qd, qdd) theta + Sᵀ F(S qd, T; shape) c,   over theta, c and shape: `solvers.separable`

`learning.friction_terms` has the equations.
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.learning.friction_terms import (
    Terms,
    equations_of,
    log_of,
    reference_temperature,
    shapes_of,
    slope_of,
    solve_terms,
    terms_of,
)
from dln_jax.mechanics.friction.laws import FrictionShape, coefficients_of
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair
from dln_jax.models.model import Model
from dln_jax.models.trees import RigidTreeParameters, Rows, make_rigid_tree
from dln_jax.types import FrictionLaw


class FrictionFit(NamedTuple):
    """Identified tree with friction, and its uncertainty."""

    model: Model
    """Model with the fitted shapes: `dynamics(fit.model.energies(fit.parameters))`."""
    parameters: RigidTreeParameters
    standard_errors: RigidTreeParameters
    """Standard error of every parameter, in its unit, within the space that the data determine."""
    shape: dict[str, Float[np.ndarray, " d"]]
    """Fitted entries of `FrictionShape`, "load", and "cooling" (k, 1/K)."""
    shape_errors: dict[str, Float[np.ndarray, " d"]]
    """Standard errors of the entries of `shape`, in their units."""
    rank: int
    """Number of combinations of linear parameters that the data determine."""
    condition: float
    """Condition number of their scaled columns."""
    reference_temperature: float | None
    """Reference temperature of viscous friction, °C; `None` if friction does not depend on temperature."""
    torque_mse: float
    """Mean over samples of the sum of squared errors over joints; (N m)² or N²."""
    converged: bool
    seconds: float
    """Duration of the whole call, compilation included."""


def fit_friction(
    tree: Tree,
    data: Trajectories,
    laws: tuple[FrictionLaw, ...],
    *,
    shape: FrictionShape | None = None,
    held: tuple[str, ...] = (),
    cooling: bool = False,
    motors: Rows | None = None,
    coupled: tuple[Pair, ...] = (),
    noise: Any = None,
    negligible: float = 1e-12,
    iterations: int = 50,
) -> FrictionFit:
    """Fits the inertias, armature and friction of a tree to measured torques.

    All samples are held in memory, N d (11 d + coefficients) numbers: decimate long logs.

    Args:
        data: samples to fit; hold out the trajectories that will judge the result.
        laws: friction laws, as in `mechanics.friction.laws`.
        shape: initial shapes; the defaults of `FrictionShape` if omitted.
        held: names of shapes that stay at their initial value.
        cooling: whether viscous friction depends on the log's temperature; its mean becomes the reference.
        motors, coupled: as for `models.make_rigid_tree`.
        noise: standard deviations of the joints' torques [d], which weight the samples (default: the torque's own).
        negligible: as for `learning.linear.fit_linear`.
        iterations: largest number of Gauss-Newton iterations.

    Raises:
        InputError: unknown laws, constant torques, a noise <= 0, or cooling without viscous friction or a temperature.
    """
    began = time.perf_counter()
    d, terms = tree.degrees_of_freedom, terms_of(laws, shape, held, cooling=cooling, motors=motors, coupled=coupled)
    with jax.enable_x64(True):
        log = log_of(tree, data, terms, noise=noise)
        solution = solve_terms(terms, log, equations_of(terms), iterations=iterations, negligible=negligible)
        fitted = {k: np.asarray(v) for k, v in shapes_of(terms.learned, solution.nonlinear, d).items()}
    weights = np.asarray(log.weights)
    left = solution.residuals.reshape(-1, d) * weights
    shaped: dict[str, Any] = {name: _plain(value) for name, value in (terms.start._asdict() | fitted).items()}
    reference = reference_temperature(data) if cooling else None
    if reference is not None:
        shaped["reference_temperature"] = reference
    model = make_rigid_tree(tree, friction=laws, motors=motors, coupled=coupled, **shaped)
    errors = np.sqrt(np.diagonal(solution.covariance))
    count = solution.linear.size
    by_shape = {name: errors[count:].reshape(-1, d)[place] for place, name in enumerate(terms.learned)}
    return FrictionFit(
        model=model,
        parameters=_parameters(solution.linear, terms, d),
        standard_errors=_parameters(errors[:count], terms, d),
        shape=fitted,
        shape_errors={name: slope_of(name, fitted[name]) * deviation for name, deviation in by_shape.items()},
        rank=solution.rank,
        condition=solution.condition,
        reference_temperature=reference,
        torque_mse=float(np.mean(np.sum(left**2, axis=1))),
        converged=solution.converged,
        seconds=time.perf_counter() - began,
    )


def _parameters(vector: np.ndarray, terms: Terms, d: int) -> RigidTreeParameters:
    links = 11 * d + len(terms.coupled)
    parts: dict[str, Any] = dict(
        zip(coefficients_of(terms.laws), map(jnp.asarray, np.reshape(vector[links:], (-1, d))), strict=True)
    )
    if terms.coupled:
        entries = zip(terms.coupled, vector[11 * d : links], strict=True)
        parts["coupling"] = {f"{i + 1}_{j + 1}": jnp.asarray(value) for (i, j), value in entries}
    inertias, armature = vector[: 10 * d].reshape(d, 10), vector[10 * d : 11 * d]
    return RigidTreeParameters(*map(jnp.asarray, (inertias, armature)), **parts)


def _plain(value: Any) -> Any:
    return tuple(np.asarray(value, float).tolist()) if np.ndim(value) else float(value)
