"""Continuous fitted value iteration: follows a network's greedy policy and fits the network to the resulting costs.

Every iteration draws states in the box and follows u = grad g*(-Bᵀ V_x) from them for N steps. Along a trajectory,
backwards, costs are added up with exponential weights (Lutter et al. 2021, arXiv:2105.04682):

    G_k = c_k + e^(-rho dt) [(1 - w) V(x_{k+1}) + w G_{k+1}],    G_N = V(x_N),    w = e^(-dt / memory)

so that all states on the way have a target, not only the first. They also have a target for the slope p_k = dG_k/dx, by
the chain rule through the closed loop, including the policy. With fixed controls instead, as in the costate of
Pontryagin's principle, slopes of an unstable plant would grow backwards wherever the controls are not yet optimal. With
a long memory the targets are the policy's own cost, whose excess over the optimum is quadratic in the policy's error,
and the iteration is Howard's policy iteration, which converges like Newton's method. With a short one they are n-step
returns, which do not require a good policy.
"""

import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh

from dln_jax.control.optimal.boxes import drawn, widened
from dln_jax.control.optimal.iteration import Iteration, Subject, iterate, score
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.value_networks import ValueNetwork
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.scale.mesh import local, program
from dln_jax.types import InputError, require_positive

VALIDATED = 256
"""Number of states from which the policy's cost is compared between iterations."""


class Progress(NamedTuple):
    """Progress after an iteration."""

    iteration: int
    loss: float
    validation: float
    """Mean cost of the policy from validation states, plus the mean of |V - cost|."""
    seconds: float
    """Time since the start, without compilation."""


class Fitted(NamedTuple):
    """Result of the iterations."""

    parameters: Any
    """Parameters with the lowest validation."""
    history: list[Progress]
    train_seconds: float
    compile_seconds: float


def fit_value(
    problem: ControlProblem,
    network: ValueNetwork,
    *,
    seed: int = 0,
    numbers: Iteration = Iteration(),  # noqa: B008
    parameters: Any = None,
    double: bool = False,
    disturbance: Disturbance | None = None,
    mesh: Mesh | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> Fitted:
    """Runs the iterations and keeps the best parameters on separate validation states.

    Args:
        problem: the control problem.
        network: family of value functions.
        seed: of parameters and states.
        numbers: of the iteration.
        parameters: initial ones; random by default.
        double: whether to compute in float64, which takes twice as long.
        disturbance: of the worst case, for a robust value.
        mesh: devices that share the states from which the policy is followed; all devices do the whole fits.
        report: called after every iteration.

    Raises:
        InputError: numbers out of range, or a value that was never finite.
    """
    given = {"numbers": numbers, "parameters": parameters, "double": double, "disturbance": disturbance}
    (found,) = fit_values(problem, network, (seed,), **given, mesh=mesh, report=report)
    return found


def fit_values(
    problem: ControlProblem,
    network: ValueNetwork,
    seeds: Sequence[int],
    *,
    numbers: Iteration = Iteration(),  # noqa: B008
    parameters: Any = None,
    double: bool = False,
    disturbance: Disturbance | None = None,
    mesh: Mesh | None = None,
    report: Callable[[Progress], None] = lambda progress: None,
) -> list[Fitted]:
    """Runs `fit_value` for several seeds, one after the other, with a program that is compiled once."""
    require_positive(**{name: number for name, number in numbers._asdict().items() if name != "slope_weight"})
    problem = widened(problem, numbers.margin)
    with jax.enable_x64(double):
        began = time.perf_counter()
        programs = _compiled(Subject(problem, network, numbers, disturbance, mesh), parameters)
        compile_seconds = time.perf_counter() - began
        return [_fit(programs, seed, numbers, parameters, report, compile_seconds) for seed in seeds]


class _Programs(NamedTuple):
    begin: Callable[[Array, Any], tuple[Any, ...]]
    """(key, parameters or none) -> parameters, state of the optimiser, validation states."""
    iterate: Callable[..., tuple[Any, Any, Array]]
    score: Callable[[Any, Array], Array]
    local: Callable[[Any], Any]
    """Turns the programs' results into arrays of this process."""


def _compiled(subject: Subject, parameters: Any) -> _Programs:
    problem, network, numbers, _, mesh = subject
    rate = optax.cosine_decay_schedule(numbers.learning_rate, numbers.iterations * numbers.steps, 0.01)
    adam = optax.adam(rate, b2=0.99)

    def begin(key: Array, parameters: Any) -> tuple[Any, ...]:
        if parameters is None:
            parameters = network.init(jax.random.fold_in(key, 0))
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)
        return parameters, adam.init(parameters), drawn(problem, jax.random.fold_in(key, 1), VALIDATED)

    key = jax.random.key(0)
    parameters, state, validated = begin(key, parameters)
    advance = program(functools.partial(iterate, subject, adam), mesh)
    judge = program(functools.partial(score, subject), mesh)
    return _Programs(
        begin,
        advance.lower(parameters, state, key, jnp.asarray(0.0)).compile(),
        judge.lower(parameters, validated).compile(),
        functools.partial(local, mesh=mesh),
    )


def _fit(
    programs: _Programs,
    seed: int,
    numbers: Iteration,
    parameters: Any,
    report: Callable[[Progress], None],
    compile_seconds: float,
) -> Fitted:
    began, key = time.perf_counter(), jax.random.key(seed)
    parameters, state, validated = programs.begin(key, parameters)
    best, least, history = parameters, math.inf, []
    for number in range(numbers.iterations):
        grown = number / max(numbers.iterations - 1, 1)
        memory = jnp.asarray(numbers.first_memory ** (1 - grown) * numbers.memory**grown)
        parameters, state, loss = programs.iterate(parameters, state, jax.random.fold_in(key, 2 + number), memory)
        now = float(programs.score(parameters, validated))
        if now < least:
            best, least = parameters, now
        history.append(Progress(number + 1, float(loss), now, time.perf_counter() - began))
        report(history[-1])
    if not math.isfinite(least):
        raise InputError("the cost of the policy was never finite; take a smaller dt, or a box that it can stay near")
    return Fitted(programs.local(best), history, time.perf_counter() - began, compile_seconds)
