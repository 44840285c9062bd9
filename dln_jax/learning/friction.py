"""Friction and inertias of a rigid tree by least squares.

    tau = Phi(q, qd, qdd) theta + Sᵀ F(S qd, T; shape) c,   over theta, c and shape: `solvers.least_squares`

The nonlinear unknowns are the logarithms of velocities and slopes, log(μ / (1 - μ)) for a load share μ, the shift of a
sigmoid, and the cooling of viscous friction (`UNKNOWNS`). With load, rows of Phi (at the motors) are multiplied by
1 ± μ tanh(u / v) with the sign of tau_link from the previous fit. Fits repeat until no sign changes.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.friction import (
    FrictionShape,
    coefficients_of,
    joint_rates,
    shape_of,
    unit_force,
)
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair, motor_regressor
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.models.model import Model
from dln_jax.models.trees import WARM, RigidTreeParameters, Rows, make_rigid_tree
from dln_jax.precision import compiled
from dln_jax.solvers.least_squares import SeparableSolution, solve_separable
from dln_jax.types import FrictionLaw, InputError, JointVector

FIRST_LOAD = 0.05
LONGEST_STEP = 1.0
"""Largest change of an unknown per iteration; a factor e for logarithms."""
MOST_ROUNDS = 5
"""Largest number of fits; the last one uses the signs of the link torques from the previous fit."""
WARMER = 10.0
"""Unit of temperature in the nonlinear unknowns, K."""
LEAST_WARMTH = 1.0
"""Smallest standard deviation of each joint's temperature for fitting its effect, K."""
USUAL_SHAPE = FrictionShape()
UNKNOWNS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "sigmoid_shift": (lambda shift: shift, lambda unknown: unknown),
    "load": (lambda share: np.log(share / (1 - share)), jax.nn.sigmoid),
    "cooling": (lambda cooling: WARMER * cooling, lambda unknown: unknown / WARMER),
}
"""Maps from fitted shapes to nonlinear unknowns and back; all other shapes use the logarithm."""


class Terms(NamedTuple):
    """Terms of a torque model besides the links (friction and motors), for fitting coefficients and shapes."""

    laws: tuple[FrictionLaw, ...]
    """As in `mechanics.friction`."""
    shape: FrictionShape = USUAL_SHAPE
    """Initial shapes."""
    held: tuple[str, ...] = ()
    """Names of shapes that keep their initial value."""
    cooling: bool = False
    """Whether viscous friction depends on temperature; the mean temperature of the log is the reference."""
    motors: Rows | None = None
    """Like `coupled`, as for `make_rigid_tree`."""
    coupled: tuple[Pair, ...] = ()

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the nonlinear unknowns: entries of `FrictionShape`, "load" and "cooling"."""
        shapes = [name for name in shape_of(self.laws) if name not in self.held]
        return (*shapes, *["load"] * ("load" in self.laws), *["cooling"] * self.cooling)


class Known(NamedTuple):
    """Known quantities in the equations, from the log and the tree; arrays with one row per sample."""

    links: Any
    """Phi of links and motors [N, d, 11 d + pairs]."""
    rates: Any
    """Motor rates S qd [N, d]."""
    warmth: Any
    """Temperature of each motor minus the reference, K [N, d]; zero without cooling."""
    tau: Any
    weights: Any
    """[N, d], scale of the joints' residuals."""
    signs: Any
    """[N, d], signs of the link torques at the motors."""


def reference_temperature(data: Trajectories) -> float:
    """Returns the mean temperature of a log to 0.1 °C; `InputError` if it is missing or hardly varies at a joint."""
    if data.temperature is None:
        raise InputError(
            "friction by temperature needs temperatures, but the data have none; add them (°C), or leave the option out"
        )
    deviations = data.temperature.std(axis=0)
    if not deviations.min() >= LEAST_WARMTH:
        joint, deviation = int(np.argmin(deviations)) + 1, deviations.min()
        raise InputError(
            f"the temperature of joint {joint} has a standard deviation of {deviation:.2g} K; expected at least "
            f"{LEAST_WARMTH:g} K: record the warm robot too"
        )
    return round(float(data.temperature.mean()), 1)


def known_of(tree: Tree, data: Trajectories, terms: Terms, *, noise: Any = None) -> Known:
    """Returns the known quantities of a log, in float64; errors as for `fit_friction`."""
    d = tree.degrees_of_freedom
    bare, (laws, shape, _, cooling, motors, coupled) = tree._replace(armature=np.zeros(d)), terms
    # The model's factory refuses wrong terms.
    make_rigid_tree(bare, friction=laws, cooling=float(cooling), motors=motors, coupled=coupled, **shape._asdict())
    weights = torque_scale(data) if noise is None else np.broadcast_to(noise, d).astype(float)
    if not (np.isfinite(weights) & (weights > 0)).all():
        raise InputError(f"noise is {noise}; expected a positive number, or one per joint")

    def columns(q: Any, qd: Any, qdd: Any) -> Any:
        links = regressor(bare, q, qd, qdd)[:, : 10 * d]
        return jnp.concatenate([links, motor_regressor(motors, coupled, qdd)], axis=1)

    state, tau = arrays_of(data, ("q", "qd", "qdd")), jnp.asarray(data.tau)
    warmth = jnp.zeros_like(tau)
    if cooling:
        reference = reference_temperature(data)  # refuses data without temperature
        warmth = jnp.asarray(data.temperature) - reference
    return Known(
        links=compiled(jax.vmap(columns))(*state),
        rates=joint_rates(motors, state[1].T).T,
        warmth=warmth,
        tau=tau,
        weights=jnp.broadcast_to(weights, tau.shape),
        signs=jnp.sign(_at_motors(terms, tau[..., None])[..., 0]),
    )


def equations(terms: Terms, unknowns: Any, known: Known) -> tuple[Any, Any]:
    """Returns the weighted columns [N d, P] and torques [N d] of all terms."""
    links, u, warmth, tau, weights, signs = known
    d = u.shape[1]
    shapes = shapes_of(terms, unknowns)
    share, cooling = shapes.pop("load", None), shapes.pop("cooling", None)
    shape = terms.shape._replace(**shapes)
    friction = jnp.zeros((*u.shape, 0))
    for name in coefficients_of(terms.laws):
        force = unit_force(name, u, shape)
        force = force * jnp.exp(-cooling * warmth) if cooling is not None and name in WARM else force
        friction = jnp.concatenate([friction, force[..., None] * np.eye(d)], axis=2)
    if share is not None:
        carried = (signs * share * jnp.tanh(u / shape.velocity_scale))[..., None] * _at_motors(terms, links)
        links = links + _from_motors(terms, carried)
    columns = jnp.concatenate([links, _from_motors(terms, friction)], axis=2) / weights[..., None]
    return columns.reshape(-1, columns.shape[2]), (tau / weights).ravel()


def _at_motors(terms: Terms, forces: Any) -> Any:
    """Multiplies forces [N, d, P] at the joints by S⁻ᵀ."""
    return (
        forces if terms.motors is None else jnp.einsum("ji,njp->nip", np.linalg.inv(np.asarray(terms.motors)), forces)
    )


def _from_motors(terms: Terms, forces: Any) -> Any:
    """Multiplies forces [N, d, P] at the motors by Sᵀ."""
    return forces if terms.motors is None else jnp.einsum("ji,njp->nip", np.asarray(terms.motors), forces)


def solve_terms(terms: Terms, known: Known, design: Callable[..., Any]) -> SeparableSolution:
    """Fits all unknowns; a dummy without effect replaces missing nonlinear unknowns.

    Args:
        design: `equations` of these terms; solutions with the same function share a compiled program.
    """
    start = {**terms.shape._asdict(), "load": FIRST_LOAD, "cooling": 0.0}
    unknowns = [
        np.broadcast_to(UNKNOWNS.get(name, (np.log,))[0](np.asarray(start[name], float)), known.tau.shape[1])
        for name in terms.learned
    ]
    solve = functools.partial(solve_separable, design, negligible=1e-12, longest_step=LONGEST_STEP)
    solution = solve(np.concatenate(unknowns) if unknowns else np.zeros(1), known)
    for _ in range(MOST_ROUNDS - 1 if "load" in terms.learned else 0):
        signs = link_signs(terms, known, solution)
        if (signs == known.signs).all():
            break
        known = known._replace(signs=signs)
        solution = solve(solution.nonlinear, known)
    return solution


def link_signs(terms: Terms, known: Known, solution: SeparableSolution) -> Any:
    """Returns the signs of the link torques at the motors that a fit predicts."""
    links = known.links @ solution.linear[: known.links.shape[2]]
    return jnp.sign(_at_motors(terms, links[..., None])[..., 0])


def shapes_of(terms: Terms, unknowns: Any) -> dict[str, Any]:
    """Converts the nonlinear unknowns to shapes [d], by name."""
    parts = unknowns.reshape(len(terms.learned), -1) if terms.learned else ()
    return {
        name: UNKNOWNS.get(name, (np.log, jnp.exp))[1](part) for name, part in zip(terms.learned, parts, strict=True)
    }


class FrictionFit(NamedTuple):
    """Identified tree with friction, and its uncertainty."""

    model: Model
    """Model with the fitted shapes: `dynamics(fit.model.energies(fit.parameters))`."""
    parameters: RigidTreeParameters
    standard_errors: RigidTreeParameters
    """Standard error of each parameter, in its unit, within the space that the data determine."""
    shape: dict[str, JointVector]
    """Fitted entries of `FrictionShape`, "load", and "cooling" (k, 1/K)."""
    shape_errors: dict[str, JointVector]
    """Standard errors of the entries of `shape`, in their units."""
    keywords: dict[str, Any]
    """Keywords of `make_rigid_tree` for the model, without friction laws: shapes, motors, and with cooling the
    reference temperature of viscous friction, °C."""
    torque_mse: float
    """Mean over samples of the sum of squared errors over joints; (N m)² or N²."""
    solution: SeparableSolution
    """Rank and condition number of the linear problem, and whether the fit converged."""


def fit_friction(
    tree: Tree,
    data: Trajectories,
    laws: tuple[FrictionLaw, ...],
    *,
    shape: FrictionShape = USUAL_SHAPE,
    held: tuple[str, ...] = (),
    cooling: bool = False,
    motors: Rows | None = None,
    coupled: tuple[Pair, ...] = (),
    noise: Any = None,
) -> FrictionFit:
    """Fits the inertias, armature and friction of a tree to measured torques.

    All samples are in memory, N d (11 d + coefficients) numbers, so decimate long logs.

    Args:
        data: samples to fit; hold out trajectories for the evaluation.
        laws, shape, held, cooling, motors, coupled: as in `Terms`.
        noise: torque noise of the joints [d], N m or N, which weights the samples (default: the spread of the torques).

    Raises:
        InputError: unknown laws, constant torques, a noise <= 0, or cooling without viscous friction or a temperature.
    """
    d, terms = tree.degrees_of_freedom, Terms(laws, shape, held, cooling, motors, coupled)
    with jax.enable_x64(True):
        known = known_of(tree, data, terms, noise=noise)
        solution = solve_terms(terms, known, functools.partial(equations, terms))
        # Each shape depends only on its own unknown, so one derivative gives all slopes.
        unknowns = jnp.asarray(solution.nonlinear)
        both = jax.jvp(functools.partial(shapes_of, terms), (unknowns,), (jnp.ones_like(unknowns),))
        fitted, slopes = jax.tree.map(np.asarray, both)
    left = solution.residuals.reshape(-1, d) * np.asarray(known.weights)
    keywords: dict[str, Any] = {"motors": motors, "coupled": coupled, **shape._asdict()}
    keywords |= {name: tuple(values.tolist()) for name, values in fitted.items()}
    if cooling:
        keywords["reference_temperature"] = reference_temperature(data)
    errors = np.sqrt(np.diagonal(solution.covariance))
    of_linear, of_shapes = np.split(errors[: solution.linear.size + d * len(terms.learned)], [solution.linear.size])
    by_shape = zip(terms.learned, of_shapes.reshape(-1, d), strict=True)
    return FrictionFit(
        model=make_rigid_tree(tree, friction=laws, **keywords),
        parameters=_parameters(solution.linear, terms, d),
        standard_errors=_parameters(of_linear, terms, d),
        shape=fitted,
        shape_errors={name: slopes[name] * deviation for name, deviation in by_shape},
        keywords=keywords,
        torque_mse=float(np.mean(np.sum(left**2, axis=1))),
        solution=solution,
    )


def _parameters(vector: np.ndarray, terms: Terms, d: int) -> RigidTreeParameters:
    inertias, armature, coupling, friction = map(
        jnp.asarray, np.split(vector, np.cumsum([10 * d, d, len(terms.coupled)]))
    )
    pairs = {f"{i + 1}_{j + 1}": value for (i, j), value in zip(terms.coupled, coupling, strict=True)}
    coefficients = dict(zip(coefficients_of(terms.laws), friction.reshape(-1, d), strict=True))
    return RigidTreeParameters(inertias.reshape(d, 10), armature, **coefficients, coupling=pairs or None)
