"""Torques of a rigid tree with friction as a separable least-squares problem.

    tau = Phi(q, qd, qdd) theta + Sᵀ F(S qd, T; shape) c

The nonlinear unknowns are the logarithms of velocities and slopes, log(μ / (1 - μ)) for a load share μ, and the shift
of a sigmoid and the cooling of viscous friction themselves. With load, rows of Phi (at the motors) are multiplied by
1 ± μ tanh(u / v) with the sign of tau_link, which comes from the previous fit; fits repeat until no sign changes.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import arrays_of
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.friction.curves import joint_rates, require_shape, unit_force
from dln_jax.mechanics.friction.laws import FrictionShape, coefficients_of, require_laws, shape_of
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair, motor_regressor, require_motors
from dln_jax.mechanics.trees.recursions import regressor
from dln_jax.models.trees import WARM, Rows
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
    shape: FrictionShape | None,
    held: tuple[str, ...],
    *,
    cooling: bool,
    motors: Rows | None,
    coupled: tuple[Pair, ...],
) -> Terms:
    """The terms of a fit; arguments as for `fit_friction`."""
    require_laws(laws, "laws")
    start = shape or FrictionShape()
    require_shape(start)
    if cooling and not set(coefficients_of(laws)) & set(WARM):
        raise InputError(f"friction has {', '.join(laws) or 'no law'}, which no temperature changes; add viscous")
    learned = tuple(name for name in shape_of(laws) if name not in held)
    return Terms(laws, (*learned, *["load"] * ("load" in laws), *["cooling"] * cooling), start, motors, coupled)


class Log(NamedTuple):
    """Known quantities, as arrays with one row per sample."""

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

    def of(self, samples: Any) -> "Log":
        """The same quantities for some of the samples."""
        return Log(*(part if name == "weights" else part[samples] for name, part in self._asdict().items()))


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


def log_of(tree: Tree, data: Trajectories, terms: Terms, *, noise: Any = None) -> Log:
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
    return Log(
        links, rates, warmth, tau, jnp.asarray(weights), jnp.sign(_at_motors(terms.motors, tau[..., None])[..., 0])
    )


def equations_of(terms: Terms) -> Callable[..., Any]:
    """(unknowns, log) -> weighted columns [N d, P] and torques [N d]; one compiled program per returned function."""
    return functools.partial(_equations, terms)


def _equations(terms: Terms, unknowns: Any, log: Log):
    links, u, warmth, tau, weights, signs = log
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


def solve_terms(
    terms: Terms, log: Log, equations: Callable[..., Any], *, iterations: int = 50, negligible: float = 1e-12
) -> SeparableSolution:
    """Fits all unknowns; without nonlinear ones, a dummy without effect takes their place."""
    d = log.tau.shape[1]
    start = [np.broadcast_to(_unknown(name, terms.start), d) for name in terms.learned]
    settings = {"iterations": iterations, "negligible": negligible, "longest_step": LONGEST_STEP}

    def solve(unknowns: np.ndarray, signs: Any) -> SeparableSolution:
        return solve_separable(equations, unknowns, log._replace(signs=jnp.asarray(signs)), **settings)

    signs = log.signs
    solution = solve(np.concatenate(start) if start else np.zeros(1), signs)
    for _ in range(MOST_ROUNDS - 1 if "load" in terms.learned else 0):
        before, signs = signs, link_signs(terms, log, solution)
        if (signs == before).all():
            break
        solution = solve(solution.nonlinear, signs)
    return solution


def link_signs(terms: Terms, log: Log, solution: SeparableSolution) -> Any:
    """Signs of the link torques at the motors, as a fit predicts them."""
    links = log.links @ solution.linear[: log.links.shape[2]]
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


def slope_of(name: str, value: np.ndarray) -> np.ndarray:
    """Derivative of a shape with respect to its unknown."""
    slopes = {"sigmoid_shift": np.ones_like(value), "cooling": np.full_like(value, 1 / WARMER)}
    return {**slopes, "load": value * (1 - value)}.get(name, value)
