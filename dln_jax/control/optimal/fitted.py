"""Continuous fitted value iteration: follows a network's greedy policy and fits the network to the resulting costs.

Every iteration draws states in the box and follows u = grad g*(-Bᵀ V_x) from them for N steps. Backwards along a
trajectory, costs are added up with exponential weights (Lutter et al. 2021, arXiv:2105.04682):

    G_k = c_k + e^(-rho dt) [(1 - w) V(x_{k+1}) + w G_{k+1}],    G_N = V(x_N),    w = e^(-dt / memory)

so all states on the way have a target, not only the first. They also have a target for the slope p_k = dG_k/dx, by the
chain rule through the closed loop, including the policy. With fixed controls, as in the costate of Pontryagin's
principle, slopes of an unstable plant would grow backwards wherever the controls are not yet optimal. With a long
memory the targets are the policy's own cost, whose excess over the optimum is quadratic in the policy's error, and the
iteration is Howard's policy iteration, which converges like Newton's method. With a short one they are n-step returns,
which do not require a good policy.
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

from dln_jax.control.optimal.flow import Targets, drawn, greedy, targets, widened
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.value_networks import ValueNetwork
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.process import held_back
from dln_jax.scale import local, program, spread
from dln_jax.types import InputError, require_positive

VALIDATED = 256
"""Number of starts for comparing the policy's cost between iterations."""


class Iteration(NamedTuple):
    """Settings of fitted value iteration."""

    iterations: int = 36
    starts: int = 1024
    """States drawn per iteration."""
    seconds: float = 3.0
    """Duration of the policy's runs from every state, s."""
    dt: float = 0.02
    """Time step, s."""
    memory: float = 3.0
    """Memory in the last iteration, s; infinite for the policy's own cost."""
    first_memory: float = 0.3
    """Memory in the first iteration, s."""
    kept: int = 8
    """States per trajectory that are fitted: the first, and others with growing distance."""
    steps: int = 200
    """Adam steps per iteration."""
    batch: int = 1024
    learning_rate: float = 1e-2
    """Peak; it decays by a cosine over all iterations."""
    slope_weight: float = 0.05
    """Weight of the slopes' misfit, in units of the box, relative to that of the values."""
    floor: float = 0.02
    """Share of the 90 % quantile of the targets that is added to every target in relative misfits."""
    followed: float = 2.0
    """Duration of runs in validation, in units of `seconds`; V stands for the costs after it."""
    margin: float = 1.25
    """Factor on the box for drawing states and clipping trajectories; 1 as published, but then the edges of the box
    affect the value inside."""


class ValueProgress(NamedTuple):
    """Progress after an iteration."""

    iteration: int
    loss: float
    validation: float
    """Mean cost of the policy from validation states, plus the mean of |V - cost|."""
    seconds: float
    """Time since the start, without compilation."""


class IterationState(NamedTuple):
    """State after some iterations of a seed; resuming from it gives the same bits as never having stopped."""

    parameters: Any
    optimiser: Any
    best: Any
    """Parameters with the lowest validation so far."""
    history: list[ValueProgress]


Restore = Callable[[int, IterationState], IterationState]
"""(seed, state before the first iteration) -> the state to resume from."""


class FittedValue(NamedTuple):
    """Result of the iterations."""

    parameters: Any
    """Parameters with the lowest validation."""
    history: list[ValueProgress]
    train_seconds: float
    compile_seconds: float


def fit_value(problem: ControlProblem, network: ValueNetwork, *, seed: int = 0, **options: Any) -> FittedValue:
    """Runs `fit_values` for one seed; `options` are its keyword arguments."""
    return fit_values(problem, network, (seed,), **options)[0]


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
    report: Callable[[ValueProgress], None] = lambda progress: None,
    restore: Restore = lambda seed, state: state,
    store: Callable[[int, IterationState], None] = lambda seed, state: None,
) -> list[FittedValue]:
    """Runs the iterations for several seeds, one after the other, with a program that is compiled once.

    The parameters of a seed are the best on separate validation states.

    Args:
        problem: the control problem.
        network: family of value functions.
        seeds: seeds of parameters and states.
        numbers: settings of the iteration.
        parameters: initial parameters; random by default.
        double: whether to compute in float64, which takes twice as long.
        disturbance: worst-case disturbance, for a robust value.
        mesh: devices that share the policy's runs; all devices do the whole fits.
        report: called after every iteration.
        restore: returns the state of a seed to resume from.
        store: called with the state of a seed after every iteration.

    Raises:
        InputError: a number is out of range, or the cost of the policy was never finite.
    """
    require_positive(**{name: number for name, number in numbers._asdict().items() if name != "slope_weight"})
    subject = _Subject(widened(problem, numbers.margin), network, numbers, disturbance, mesh)
    rate = optax.cosine_decay_schedule(numbers.learning_rate, numbers.iterations * numbers.steps, 0.01)
    adam = optax.adam(rate, b2=0.99)

    def begin(key: Array) -> tuple[Any, Any, Array]:
        """Returns parameters, state of the optimiser, and validation states."""
        start = network.init(jax.random.fold_in(key, 0)) if parameters is None else parameters
        start = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), start)
        return start, adam.init(start), drawn(subject.problem, jax.random.fold_in(key, 1), VALIDATED)

    with jax.enable_x64(double):
        began, key = time.perf_counter(), jax.random.key(0)
        start, state, validated = begin(key)
        advance = program(functools.partial(_iterate, subject, adam), mesh)
        advance = advance.lower(start, state, key, jnp.asarray(0.0)).compile()
        judge = program(functools.partial(_score, subject), mesh).lower(start, validated).compile()
        compile_seconds = time.perf_counter() - began

        def fit(seed: int) -> FittedValue:
            began, key = time.perf_counter(), jax.random.key(seed)
            current, state, validated = begin(key)
            current, state, best, history = restore(seed, IterationState(current, state, current, []))
            history, spent = list(history), history[-1].seconds if history else 0.0
            lowest = min((at.validation for at in history if math.isfinite(at.validation)), default=math.inf)
            for number in range(len(history), numbers.iterations):
                grown = number / max(numbers.iterations - 1, 1)
                memory = jnp.asarray(numbers.first_memory ** (1 - grown) * numbers.memory**grown)
                with held_back():  # an interrupt inside of XLA is lost, or ends the process by SIGABRT
                    current, state, loss = advance(current, state, jax.random.fold_in(key, 2 + number), memory)
                    score = float(judge(current, validated))
                    if score < lowest:
                        best, lowest = current, score
                    passed = spent + time.perf_counter() - began
                    history.append(ValueProgress(number + 1, float(loss), score, passed))
                    store(seed, IterationState(current, state, best, list(history)))
                report(history[-1])
            if not math.isfinite(lowest):
                raise InputError(
                    "the cost of the policy was never finite; take a smaller dt, or a box that it can stay near"
                )
            return FittedValue(local(best, mesh), history, history[-1].seconds, compile_seconds)

        return [fit(seed) for seed in seeds]


class _Subject(NamedTuple):
    """Problem, network and settings of the iterations."""

    problem: ControlProblem
    network: ValueNetwork
    numbers: Iteration
    disturbance: Disturbance | None
    mesh: Mesh | None
    """Devices that share the trajectories; all devices do the whole fit."""

    @property
    def steps(self) -> int:
        """Number of steps of a trajectory."""
        return round(self.numbers.seconds / self.numbers.dt)


def _iterate(
    subject: _Subject, adam: optax.GradientTransformation, parameters: Any, state: Any, key: Array, memory: Array
) -> tuple[Any, Any, Array]:
    """Returns parameters, state of the optimiser and mean loss after an iteration with this memory, in s."""
    problem, network, numbers = subject.problem, subject.network, subject.numbers
    of_starts, of_batches = jax.random.split(key)
    data = _kept_targets(subject, parameters, drawn(problem, of_starts, numbers.starts), memory)
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
        batch = jax.tree.map(lambda rows: rows[jax.random.randint(key, (numbers.batch,), 0, len(data.V))], data)
        value, gradient = jax.value_and_grad(loss)(parameters, batch)
        updates, state = adam.update(gradient, state, parameters)
        return (optax.apply_updates(parameters, updates), state), value

    keys = jax.random.split(of_batches, numbers.steps)
    (parameters, state), losses = jax.lax.scan(descend, (parameters, state), keys)
    return parameters, state, jnp.mean(losses)


def _kept_targets(subject: _Subject, parameters: Any, x: Array, memory: Array) -> Targets:
    """Returns targets at some states of the trajectories from x [N, n], one row per state."""

    def of_start(parameters: Any, memory: Array, x: Array) -> Targets:
        return targets(
            subject.problem,
            lambda x: subject.network.value_and_gradient(parameters, x),
            x,
            steps=subject.steps,
            dt=subject.numbers.dt,
            memory=memory,
            disturbance=subject.disturbance,
        )

    trajectories = spread(lambda shared, x: jax.vmap(functools.partial(of_start, *shared))(x), subject.mesh)
    kept = subject.numbers.kept
    index = np.unique((subject.steps * (np.arange(kept) / kept) ** 2).astype(int))
    return jax.tree.map(lambda rows: rows[:, index].reshape(-1, *rows.shape[2:]), trajectories((parameters, memory), x))


def _robust(off: Array) -> Array:
    """Returns a loss, quadratic for small errors and linear for large ones, because slopes jump at a ridge of V."""
    size = 0.1
    return size**2 * (jnp.sqrt(1 + (off / size) ** 2) - 1)


def _score(subject: _Subject, parameters: Any, x: Array) -> Array:
    """Returns the mean cost of the policy from states x [N, n], plus the mean of |V - cost|."""
    problem, network, dt = subject.problem, subject.network, subject.numbers.dt
    steps = round(subject.numbers.followed * subject.steps)

    def one(parameters: Any, x: Array) -> tuple[Array, Array]:
        value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
        closed, discount = greedy(problem, value, dt, subject.disturbance), math.exp(-problem.discount * dt)

        def forward(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
            x, total, weight = carry
            after, cost = closed(x)
            return (after, total + weight * cost, weight * discount), None

        (last, total, weight), _ = jax.lax.scan(
            forward,
            (x, jnp.zeros((), x.dtype), jnp.ones((), x.dtype)),
            length=steps,
        )
        return value(x)[0], total + weight * value(last)[0]

    V, cost = spread(jax.vmap(one, (None, 0)), subject.mesh)(parameters, x)
    return jnp.mean(cost + jnp.abs(V - cost))
