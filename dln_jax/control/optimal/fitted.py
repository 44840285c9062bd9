"""Continuous fitted value iteration: a network's greedy policy is followed, and the network fitted to what that costs.

Each iteration draws states in the box and follows u = grad g*(-Bᵀ V_x) from them for N steps. Along each trajectory,
backwards, costs are added up with exponential weights (Lutter et al. 2021, arXiv:2105.04682):

    G_k = c_k + e^(-rho dt) [(1 - w) V(x_{k+1}) + w G_{k+1}],    G_N = V(x_N),    w = e^(-dt / memory)

so that every state on the way has a target, and not the first alone. So has its slope p_k = dG_k/dx, by the chain rule
through the closed loop, policy and all: with the controls held instead, as in the costate of Pontryagin's principle,
slopes of an unstable plant would grow backwards wherever the controls are not yet best. With a long memory the targets
are the policy's own cost, above the best by the square of what the policy is off, and the iteration is Howard's of
policies, which converges as Newton's method does. With a short one they are those of n-step returns, which need no good
policy.
"""

import functools
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.sharding import Mesh

from dln_jax.control.optimal.adversaries import Disturbance
from dln_jax.control.optimal.boxes import drawn, widened
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.targets import Targets, greedy, targets
from dln_jax.control.optimal.value_networks import ValueNetwork
from dln_jax.scale.mesh import local, program, spread
from dln_jax.types import InputError, require_positive

VALIDATED = 256
"""States from which the policy's cost is compared between iterations."""


class Iteration(NamedTuple):
    """Numbers of fitted value iteration."""

    iterations: int = 36
    starts: int = 1024
    """States that are drawn in an iteration."""
    seconds: float = 3.0
    """For which the policy is followed from each."""
    dt: float = 0.02
    """s, of a step."""
    memory: float = 3.0
    """s, in the last iteration; infinite for the policy's own cost."""
    first_memory: float = 0.3
    """s, in the first."""
    kept: int = 8
    """States of a trajectory that are fitted: the first, and others ever less densely."""
    steps: int = 200
    """Of Adam in an iteration."""
    batch: int = 1024
    learning_rate: float = 1e-2
    """The largest; falls by a cosine over all iterations."""
    slope_weight: float = 0.05
    """Of the slopes' misfit, in units of the box, beside that of the values."""
    floor: float = 0.02
    """Share of the largest target that is added to a target to make a misfit relative."""
    margin: float = 1.25
    """Factor on the box: states are drawn within, and trajectories end there; 1 as published, where a value of the box
    alone counts what its edges do."""


class Progress(NamedTuple):
    """Of an iteration."""

    iteration: int
    loss: float
    validation: float
    """Mean cost of the policy from validation states, and what V is off it."""
    seconds: float
    """Since the start, compilation apart."""


class Fitted(NamedTuple):
    """What came of an iteration."""

    parameters: Any
    """Those with the least validation."""
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
    """Iterates, and keeps what does best from validation states that are drawn apart.

    Args:
        problem: what is controlled.
        network: family of values.
        seed: of parameters and states.
        numbers: of the iteration.
        parameters: to start from; by default drawn.
        double: whether to compute in float64, which takes twice as long.
        disturbance: of an adversary, for a robust value.
        mesh: devices that share the states from which the policy is followed; the fits are done by each.
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
    """As `fit_value` for several seeds, one after the other, by a program that is compiled once."""
    require_positive(**{name: number for name, number in numbers._asdict().items() if name != "slope_weight"})
    problem = widened(problem, numbers.margin)
    with jax.enable_x64(double):
        began = time.perf_counter()
        programs = _compiled(problem, network, numbers, parameters, disturbance, mesh)
        compile_seconds = time.perf_counter() - began
        return [_fit(programs, seed, numbers, parameters, report, compile_seconds) for seed in seeds]


class _Programs(NamedTuple):
    begin: Callable[[Array, Any], tuple[Any, ...]]
    """(key, parameters or none) -> parameters, state of the optimiser, validation states."""
    iterate: Callable[..., tuple[Any, Any, Array]]
    score: Callable[[Any, Array], Array]
    local: Callable[[Any], Any]
    """What the programs give, as arrays of this process."""


def _compiled(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    parameters: Any,
    disturbance: Disturbance | None,
    mesh: Mesh | None,
) -> _Programs:
    rate = optax.cosine_decay_schedule(numbers.learning_rate, numbers.iterations * numbers.steps, 0.01)
    adam = optax.adam(rate, b2=0.99)

    def begin(key: Array, parameters: Any) -> tuple[Any, ...]:
        if parameters is None:
            parameters = network.init(jax.random.fold_in(key, 0))
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), parameters)
        return parameters, adam.init(parameters), drawn(problem, jax.random.fold_in(key, 1), VALIDATED)

    key = jax.random.key(0)
    parameters, state, validated = begin(key, parameters)
    iterate = program(functools.partial(_iterate, problem, network, numbers, disturbance, adam, mesh), mesh)
    score = program(functools.partial(_score, problem, network, numbers, disturbance, mesh), mesh)
    return _Programs(
        begin,
        iterate.lower(parameters, state, key, jnp.asarray(0.0)).compile(),
        score.lower(parameters, validated).compile(),
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


def _iterate(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    disturbance: Disturbance | None,
    adam: optax.GradientTransformation,
    mesh: Mesh | None,
    parameters: Any,
    state: Any,
    key: Array,
    memory: Array,
) -> tuple[Any, Any, Array]:
    of_starts, of_batches = jax.random.split(key)
    steps = round(numbers.seconds / numbers.dt)
    x = drawn(problem, of_starts, numbers.starts)

    def of_start(parameters: Any, memory: Array, x: Array) -> Targets:
        return targets(
            problem,
            lambda x: network.value_and_gradient(parameters, x),
            x,
            steps=steps,
            dt=numbers.dt,
            memory=memory,
            disturbance=disturbance,
        )

    trajectories = spread(lambda shared, x: jax.vmap(functools.partial(of_start, *shared))(x), mesh)
    found = trajectories((parameters, memory), x)
    index = np.unique((steps * (np.arange(numbers.kept) / numbers.kept) ** 2).astype(int))
    data = jax.tree.map(lambda each: each[:, index].reshape(-1, *each.shape[2:]), found)
    half = jnp.asarray((np.asarray(problem.high) - np.asarray(problem.low)) / 2, float)
    largest = jnp.quantile(data.V, 0.9)

    def loss(parameters: Any, batch: Targets) -> Array:
        V, slope = jax.vmap(lambda x: network.members(parameters, x))(batch.x)
        size = (batch.V + numbers.floor * largest)[:, None]
        off = (V - batch.V[:, None]) / size
        off_slope = (slope - batch.slope[:, None]) * half / size[..., None]
        return jnp.mean(_robust(off)) + numbers.slope_weight * jnp.mean(_robust(off_slope))

    def descend(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], Array]:
        parameters, state = carry
        batch = jax.tree.map(lambda each: each[jax.random.randint(key, (numbers.batch,), 0, len(data.V))], data)
        value, gradient = jax.value_and_grad(loss)(parameters, batch)
        updates, state = adam.update(gradient, state, parameters)
        return (optax.apply_updates(parameters, updates), state), value

    keys = jax.random.split(of_batches, numbers.steps)
    (parameters, state), losses = jax.lax.scan(descend, (parameters, state), keys)
    return parameters, state, jnp.mean(losses)


def _robust(off: Array) -> Array:
    """Quadratic where small, else linear: at a ridge the slopes of either side are far from each other."""
    size = 0.1
    return size**2 * (jnp.sqrt(1 + (off / size) ** 2) - 1)


def _score(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    disturbance: Disturbance | None,
    mesh: Mesh | None,
    parameters: Any,
    x: Array,
) -> Array:
    steps = round(numbers.seconds / numbers.dt)

    def one(parameters: Any, x: Array) -> tuple[Array, Array]:
        value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
        closed, discount = greedy(problem, value, numbers.dt, disturbance), math.exp(-problem.discount * numbers.dt)

        def forward(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
            x, total, weight = carry
            after, cost = closed(x)
            return (after, total + weight * cost, weight * discount), None

        (last, total, weight), _ = jax.lax.scan(
            forward, (x, jnp.zeros((), x.dtype), jnp.ones((), x.dtype)), length=2 * steps
        )
        return value(x)[0], total + weight * value(last)[0]

    V, cost = spread(jax.vmap(one, (None, 0)), mesh)(parameters, x)
    return jnp.mean(cost + jnp.abs(V - cost))
