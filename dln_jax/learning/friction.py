"""Friction and inertias of a rigid tree by least squares, and the choice of optional terms.

    tau = Phi(q, qd, qdd) theta + Sᵀ F(S qd, T; shape) c,   over theta, c and shape: `solvers.separable`

The nonlinear unknowns are the logarithms of velocities and slopes, log(μ / (1 - μ)) for a load share μ, and the shift
of a sigmoid and the cooling of viscous friction themselves. With load, rows of Phi (at the motors) are multiplied by
1 ± μ tanh(u / v) with the sign of tau_link, which comes from the previous fit; fits repeat until no sign changes.

Any extra term lowers the error on its own training data, whether or not the plant has it. `choose_terms` therefore
keeps a term only if it lowers the error in cross-validation over trajectories (or blocks of time) by more than `MARGIN`
standard errors. Such terms are coupled motors, friction that depends on load, and friction that depends on temperature.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, every, in_blocks
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.select import segments, significantly_better
from dln_jax.mechanics.friction.curves import joint_rates, require_shape, unit_force
from dln_jax.mechanics.friction.laws import FrictionShape, coefficients_of, require_laws, shape_of
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair, motor_regressor, require_motors
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.models.model import Model
from dln_jax.models.trees import WARM, RigidTreeParameters, Rows, make_rigid_tree
from dln_jax.precision import quick_compilation
from dln_jax.solvers.separable import SeparableSolution, solve_separable
from dln_jax.types import FrictionLaw, InputError

FIRST_LOAD = 0.05
LONGEST_STEP = 1.0
"""Largest change of an unknown per iteration: a factor e for quantities fitted by their logarithm."""
MOST_ROUNDS = 5
"""Largest number of fits; the signs of the link torques before the last one are then final."""
WARMER = 10.0
"""Unit of temperature in the nonlinear unknowns, K."""
LEAST_WARMTH = 1.0
"""The effect of temperature is fitted if each joint's temperature has at least this standard deviation, K."""
FOLDS = 4
MOST_SAMPLES = 2_000
MARGIN = 2.0
"""A term must lower the error by this number of standard errors; about one log in forty does so by chance."""


class Terms(NamedTuple):
    """Friction laws, fitted shapes and coupled motors of a torque model."""

    laws: tuple[FrictionLaw, ...]
    learned: tuple[str, ...]
    """Nonlinear unknowns, by name: entries of `FrictionShape`, "load" and "cooling"."""
    start: FrictionShape
    motors: Rows | None
    coupled: tuple[Pair, ...]


def terms_of(
    laws: tuple[FrictionLaw, ...],
    shape: FrictionShape | None = None,
    held: tuple[str, ...] = (),
    *,
    cooling: bool = False,
    motors: Rows | None = None,
    coupled: tuple[Pair, ...] = (),
) -> Terms:
    """The terms of a fit; arguments as for `fit_friction`."""
    require_laws(laws, "laws")
    start = shape or FrictionShape()
    require_shape(start)
    if cooling and not set(coefficients_of(laws)) & set(WARM):
        raise InputError(f"friction has {', '.join(laws) or 'no law'}, which no temperature changes; add viscous")
    learned = tuple(name for name in shape_of(laws) if name not in held)
    return Terms(laws, (*learned, *["load"] * ("load" in laws), *["cooling"] * cooling), start, motors, coupled)


class Known(NamedTuple):
    """What the log and the tree give the equations, in arrays with one row per sample."""

    links: Any
    """Phi of links and motors [N, d, 11 d + pairs]."""
    rates: Any
    """Motor rates S qd [N, d]."""
    warmth: Any
    """Temperature of every motor minus the reference, K [N, d]; zero without cooling."""
    tau: Any
    weights: Any
    """[d], scale of the joints' residuals."""
    signs: Any
    """[N, d], signs of the link torques at the motors."""


def reference_temperature(data: Trajectories) -> float:
    """Mean temperature of a log to 0.1 °C; `InputError` if there is none, or that of a joint hardly varies."""
    if data.temperature is None:
        raise InputError(
            "friction is to depend on temperature, which the data do not have; add it (°C), or leave that out"
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
    """Returns the known quantities of a log, in float64; arguments and errors as for `fit_friction`."""
    d = tree.degrees_of_freedom
    require_motors(terms.motors, terms.coupled, d)
    weights = np.asarray(torque_scale(data) if noise is None else np.broadcast_to(noise, d), float)
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise InputError(f"noise is {noise}; expected a positive number, or one for each joint")

    def columns(q: Any, qd: Any, qdd: Any) -> Any:
        links = regressor(tree._replace(armature=np.zeros(d)), q, qd, qdd)[:, : 10 * d]
        return jnp.concatenate([links, motor_regressor(terms.motors, terms.coupled, qdd)], axis=1)

    state = arrays_of(data, ("q", "qd", "qdd"))
    warmth = jnp.zeros_like(state[1])
    if "cooling" in terms.learned:
        reference = reference_temperature(data)  # refuses data without temperature
        warmth = jnp.asarray(data.temperature) - reference
    rates, tau = jax.vmap(lambda qd: joint_rates(terms.motors, qd))(state[1]), jnp.asarray(data.tau)
    links = jax.jit(jax.vmap(columns), compiler_options=quick_compilation())(*state)
    return Known(
        links, rates, warmth, tau, jnp.asarray(weights), jnp.sign(_at_motors(terms.motors, tau[..., None])[..., 0])
    )


def equations(terms: Terms, unknowns: Any, known: Known) -> tuple[Any, Any]:
    """Weighted columns [N d, P] and torques [N d] of all terms."""
    links, u, warmth, tau, weights, signs = known
    shapes = shapes_of(terms.learned, unknowns, u.shape[1])
    share, cooling = shapes.pop("load", None), shapes.pop("cooling", None)
    shape = terms.start._replace(**shapes)
    columns = []
    for name in coefficients_of(terms.laws):
        force = jax.vmap(lambda rates, name=name: unit_force(name, rates, shape))(u)
        force = force * jnp.exp(-cooling * warmth) if cooling is not None and name in WARM else force
        columns.append(jax.vmap(jnp.diag)(force))
    friction = jnp.concatenate(columns, axis=2) if columns else jnp.zeros((*u.shape, 0))
    if share is not None:
        links = links + _from_motors(
            terms.motors,
            (signs * share * jnp.tanh(u / shape.velocity_scale))[..., None] * _at_motors(terms.motors, links),
        )
    every = jnp.concatenate([links, _from_motors(terms.motors, friction)], axis=2) / weights[:, None]
    return every.reshape(-1, every.shape[2]), (tau / weights).ravel()


def _at_motors(motors: Rows | None, forces: Any) -> Any:
    """S⁻ᵀ of forces [N, d, P] at the joints."""
    return forces if motors is None else jnp.einsum("ij,njp->nip", np.linalg.inv(np.asarray(motors)).T, forces)


def _from_motors(motors: Rows | None, forces: Any) -> Any:
    """Sᵀ of forces [N, d, P] at the motors."""
    return forces if motors is None else jnp.einsum("ji,njp->nip", np.asarray(motors), forces)


def solve_terms(terms: Terms, known: Known, design: Callable[..., Any]) -> SeparableSolution:
    """Fits all unknowns; without nonlinear ones, a dummy without effect takes their place.

    Args:
        design: `equations` of these terms; solutions with the same function share a compiled program.
    """
    d = known.tau.shape[1]
    start = [np.broadcast_to(_unknown(name, terms.start), d) for name in terms.learned]

    def solve(unknowns: np.ndarray, signs: Any) -> SeparableSolution:
        now = known._replace(signs=jnp.asarray(signs))
        return solve_separable(design, unknowns, now, negligible=1e-12, longest_step=LONGEST_STEP)

    signs = known.signs
    solution = solve(np.concatenate(start) if start else np.zeros(1), signs)
    for _ in range(MOST_ROUNDS - 1 if "load" in terms.learned else 0):
        before, signs = signs, link_signs(terms, known, solution)
        if (signs == before).all():
            break
        solution = solve(solution.nonlinear, signs)
    return solution


def link_signs(terms: Terms, known: Known, solution: SeparableSolution) -> Any:
    """Signs of the link torques at the motors, as a fit predicts them."""
    links = known.links @ solution.linear[: known.links.shape[2]]
    return jnp.sign(_at_motors(terms.motors, links[..., None])[..., 0])


def _unknown(name: str, start: FrictionShape) -> Any:
    if name == "load":
        return np.log(FIRST_LOAD / (1 - FIRST_LOAD))
    if name == "cooling":
        return 0.0
    value = np.asarray(getattr(start, name), float)
    return value if name == "sigmoid_shift" else np.log(value)


def shapes_of(learned: tuple[str, ...], unknowns: Any, d: int) -> dict[str, Any]:
    """Converts the nonlinear unknowns to shapes [d], by name."""
    inverse = {"sigmoid_shift": lambda x: x, "load": jax.nn.sigmoid, "cooling": lambda x: x / WARMER}
    return {
        name: inverse.get(name, jnp.exp)(unknowns[place * d : (place + 1) * d]) for place, name in enumerate(learned)
    }


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

    Raises:
        InputError: unknown laws, constant torques, a noise <= 0, or cooling without viscous friction or a temperature.
    """
    d, terms = tree.degrees_of_freedom, terms_of(laws, shape, held, cooling=cooling, motors=motors, coupled=coupled)
    with jax.enable_x64(True):
        known = known_of(tree, data, terms, noise=noise)
        design = functools.partial(equations, terms)
        solution = solve_terms(terms, known, design)
        # Every shape depends on its own unknown alone, so that one derivative holds the slopes of all.
        fitted, slopes = jax.jvp(
            lambda unknowns: shapes_of(terms.learned, unknowns, d),
            (jnp.asarray(solution.nonlinear),),
            (jnp.ones(solution.nonlinear.shape),),
        )
        fitted, slopes = jax.tree.map(np.asarray, (fitted, slopes))
    left = solution.residuals.reshape(-1, d) * np.asarray(known.weights)
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
        shape_errors={name: slopes[name] * deviation for name, deviation in by_shape.items()},
        rank=solution.rank,
        condition=solution.condition,
        reference_temperature=reference,
        torque_mse=float(np.mean(np.sum(left**2, axis=1))),
        converged=solution.converged,
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


class TriedTerm(NamedTuple):
    """A term and the errors with and without it."""

    name: str
    without: float
    """Mean squared error in cross-validation, summed over joints, in units of each torque's variance."""
    within: float
    """The same, with the term."""
    kept: bool


def choose_terms(
    tree: Tree, data: Trajectories, terms: Terms, candidates: Sequence[tuple[str, Terms]]
) -> tuple[Terms, list[TriedTerm]]:
    """Tries candidates one after another and keeps those that lower the cross-validation error significantly.

    Args:
        candidates: name of each candidate, and the terms that it adds.

    Raises:
        InputError: as for `fit_friction`.
    """
    if not candidates:
        return terms, []
    if len(np.unique(data.trajectory)) < FOLDS:
        data = in_blocks(data, BLOCKS)
    data = every(data, -(-len(data.t) // MOST_SAMPLES))
    segment, tried = segments(data), []
    errors = cross_validate(tree, data, terms, segment)
    for name, candidate in candidates:
        union = {
            part: tuple(dict.fromkeys((*getattr(terms, part), *getattr(candidate, part))))
            for part in ("laws", "learned", "coupled")
        }
        wider = terms._replace(**union)
        trial = cross_validate(tree, data, wider, segment)
        kept = significantly_better(trial, errors, margin=MARGIN)
        tried.append(TriedTerm(name, float(errors.mean()), float(trial.mean()), kept))
        if kept:
            terms, errors = wider, trial
    return terms, tried


def cross_validate(tree: Tree, data: Trajectories, terms: Terms, segment: np.ndarray) -> Float[np.ndarray, " segments"]:
    """Mean squared error of every segment, from fits to the folds without it."""
    present = np.unique(data.trajectory)
    folds = [np.isin(data.trajectory, present[fold::FOLDS]) for fold in range(FOLDS)]
    fewest = min(int(np.sum(~held)) for held in folds)
    with jax.enable_x64(True):
        known, design = known_of(tree, data, terms), functools.partial(equations, terms)
        evaluate = jax.jit(design)
        squares = np.zeros(len(data.t))
        for held in folds:
            rest = np.flatnonzero(~held)
            # The same number of samples in every fold, so that one compiled program serves all.
            rows = rest[np.linspace(0, len(rest) - 1, fewest).round().astype(int)]
            some = Known(*(part if name == "weights" else part[rows] for name, part in known._asdict().items()))
            solution = solve_terms(terms, some, design)
            whole = known._replace(signs=link_signs(terms, known, solution))
            A, b = (np.asarray(part) for part in evaluate(solution.nonlinear, whole))
            squares[held] = np.sum((A @ solution.linear - b).reshape(len(data.t), -1) ** 2, axis=1)[held]
    return np.bincount(segment, squares) / np.bincount(segment)
