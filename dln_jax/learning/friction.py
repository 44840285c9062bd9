"""Identifies the friction and the inertias of a rigid tree: linear coefficients directly, curve shapes by Gauss-Newton.

    tau = Phi(q, qd, qdd) theta + F(qd; shape) c,   over theta, c and shape: `solvers.separable`

Velocities, slopes and load shares are fitted by their logarithms (a share by that of μ / (1 - μ)). With load, rows of
Phi are multiplied by 1 ± μ tanh(u / v) with the sign of tau_link. The sign comes from the previous fit, and the fit is
repeated until the signs no longer change.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.friction import (
    FrictionShape,
    coefficients_of,
    require_laws,
    require_shape,
    shape_of,
    unit_force,
)
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.models.model import Model
from dln_jax.models.rigid_tree import RigidTreeParameters, make_rigid_tree
from dln_jax.solvers.separable import SeparableSolution, solve_separable
from dln_jax.types import FrictionLaw, InputError

FIRST_LOAD = 0.05
"""Initial share of load."""
LONGEST_STEP = 1.0
"""Largest change of an unknown per iteration: a factor e for quantities fitted by their logarithm."""
MOST_ROUNDS = 5
"""Largest number of fits; the signs of the link torques before the last one are then final."""


class FrictionFit(NamedTuple):
    """Identified tree with friction, and its uncertainty."""

    model: Model
    """Model with the fitted shapes: `dynamics(fit.model.energies(fit.parameters))`."""
    parameters: RigidTreeParameters
    standard_errors: RigidTreeParameters
    """Standard error of every parameter, in its unit, within the space that the data determine."""
    shape: dict[str, Float[np.ndarray, " d"]]
    """Fitted entries of `FrictionShape`, and "load"."""
    shape_errors: dict[str, Float[np.ndarray, " d"]]
    """Standard errors of the entries of `shape`, in their units."""
    rank: int
    """Number of combinations of linear parameters that the data determine."""
    condition: float
    """Condition number of their scaled columns."""
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
    noise: Any = None,
    negligible: float = 1e-12,
    iterations: int = 50,
) -> FrictionFit:
    """Fits the inertias, armature and friction of a tree to measured torques.

    All samples are held in memory, N d (11 d + coefficients) numbers: decimate long logs.

    Args:
        tree: tree with known frames.
        data: samples to fit; hold out the trajectories that will judge the result.
        laws: friction laws, as in `mechanics.friction.laws`.
        shape: initial shapes; the defaults of `FrictionShape` if omitted.
        held: names of shapes that stay at their initial value.
        noise: standard deviations of the joints' torques [d], which weight the samples; the torque's own deviation by
            default.
        negligible: as for `learning.linear.fit_linear`.
        iterations: largest number of Gauss-Newton iterations.

    Raises:
        InputError: unknown laws, only linear coefficients to fit (use `fit_linear`), torques that do not vary, or a
            noise that is not positive.
    """
    began = time.perf_counter()
    require_laws(laws, "laws")
    start = shape or FrictionShape()
    require_shape(start)
    d = tree.degrees_of_freedom
    learned = tuple(name for name in shape_of(laws) if name not in held) + ("load",) * ("load" in laws)
    if not learned:
        raise InputError(f"{', '.join(laws) or 'no law'} has no shape to find; fit_linear finds the coefficients")
    with jax.enable_x64(True):
        weights = np.asarray(torque_scale(data) if noise is None else np.broadcast_to(noise, d), float)
        if not (np.isfinite(weights).all() and (weights > 0).all()):
            raise InputError(f"noise is {noise}; expected a positive number, or one for each joint")
        state = arrays_of(data, ("q", "qd", "qdd"))
        columns = jax.jit(jax.vmap(functools.partial(regressor, tree)), compiler_options=quick_compilation())
        log = _Log(columns(*state), state[1], jnp.asarray(data.tau), jnp.asarray(weights))
        equations = functools.partial(_equations, laws, learned, start)
        unknowns = np.concatenate([np.broadcast_to(_unknown(name, start), d) for name in learned])
        settings = {"iterations": iterations, "negligible": negligible, "longest_step": LONGEST_STEP}
        solution = _solve(equations, unknowns, log, settings, rounds="load" in laws)
        fitted = {name: np.asarray(values) for name, values in _shapes(learned, solution.nonlinear, d).items()}
    left = solution.residuals.reshape(-1, d) * weights
    shaped: dict[str, Any] = {name: _plain(value) for name, value in (start._asdict() | fitted).items()}
    model = make_rigid_tree(tree, friction=laws, **shaped)
    errors = np.sqrt(np.diagonal(solution.covariance))
    count = solution.linear.size
    by_shape = {name: errors[count:].reshape(-1, d)[place] for place, name in enumerate(learned)}
    return FrictionFit(
        model=model,
        parameters=_parameters(solution.linear, laws, d),
        standard_errors=_parameters(errors[:count], laws, d),
        shape=fitted,
        shape_errors={name: _slope(name, fitted[name]) * deviation for name, deviation in by_shape.items()},
        rank=solution.rank,
        condition=solution.condition,
        torque_mse=float(np.mean(np.sum(left**2, axis=1))),
        converged=solution.converged,
        seconds=time.perf_counter() - began,
    )


class _Log(NamedTuple):
    """Known quantities, as arrays with one row per sample."""

    links: Any
    """Phi [N, d, 11 d]."""
    qd: Any
    tau: Any
    weights: Any
    """[d], scale of the joints' residuals."""
    signs: Any = None
    """[N, d], signs of the link torques."""


def _equations(laws: tuple[FrictionLaw, ...], learned: tuple[str, ...], start: FrictionShape, unknowns: Any, log: _Log):
    """Weighted columns and torques, [N d, P] and [N d]."""
    links, qd, tau, weights, signs = log
    shapes = _shapes(learned, unknowns, qd.shape[1])
    share = shapes.pop("load", None)
    shape = start._replace(**shapes)
    columns = [
        jax.vmap(lambda u, name=name: jnp.diag(unit_force(name, u, shape)))(qd) for name in coefficients_of(laws)
    ]
    if share is not None:
        links = links * (1 + signs * share * jnp.tanh(qd / shape.velocity_scale))[..., None]
    every = jnp.concatenate([links, *columns], axis=2) / weights[:, None]
    return every.reshape(-1, every.shape[2]), (tau / weights).ravel()


def _solve(
    equations: Callable[..., Any], unknowns: np.ndarray, log: _Log, settings: dict[str, Any], *, rounds: bool
) -> SeparableSolution:
    def solve(unknowns: np.ndarray, signs: np.ndarray) -> SeparableSolution:
        return solve_separable(equations, unknowns, log._replace(signs=jnp.asarray(signs)), **settings)

    signs = np.sign(np.asarray(log.tau))
    solution = solve(unknowns, signs)
    for _ in range(MOST_ROUNDS - 1 if rounds else 0):
        before, signs = signs, np.sign(np.asarray(log.links) @ solution.linear[: log.links.shape[2]])
        if (signs == before).all():
            break
        solution = solve(solution.nonlinear, signs)
    return solution


def _unknown(name: str, start: FrictionShape) -> Any:
    if name == "load":
        return np.log(FIRST_LOAD / (1 - FIRST_LOAD))
    value = np.asarray(getattr(start, name), float)
    return value if name == "sigmoid_shift" else np.log(value)


def _shapes(learned: tuple[str, ...], unknowns: Any, d: int) -> dict[str, Any]:
    """Shapes [d] that the unknowns stand for, by name."""
    inverse = {"sigmoid_shift": lambda x: x, "load": jax.nn.sigmoid}
    return {
        name: inverse.get(name, jnp.exp)(unknowns[place * d : (place + 1) * d]) for place, name in enumerate(learned)
    }


def _slope(name: str, value: np.ndarray) -> np.ndarray:
    """Derivative of a shape by its unknown."""
    return {"sigmoid_shift": np.ones_like(value), "load": value * (1 - value)}.get(name, value)


def _parameters(vector: np.ndarray, laws: tuple[FrictionLaw, ...], d: int) -> RigidTreeParameters:
    parts = dict(zip(coefficients_of(laws), np.reshape(vector[11 * d :], (-1, d)), strict=True))
    inertias, armature = vector[: 10 * d].reshape(d, 10), vector[10 * d : 11 * d]
    return RigidTreeParameters(*map(jnp.asarray, (inertias, armature)), **{k: jnp.asarray(v) for k, v in parts.items()})


def _plain(value: Any) -> Any:
    return tuple(np.asarray(value, float).tolist()) if np.ndim(value) else float(value)
