"""Continuous fitted value iteration: follows a network's greedy policy and fits the network to the resulting costs.

Every iteration draws states in the box and follows u = grad g*(-Bᵀ V_x) from them for N steps. Backwards along a
trajectory, costs are added up with exponential weights (Lutter et al. 2021, arXiv:2105.04682):

    G_k = c_k + e^(-rho dt) [(1 - w) V(x_{k+1}) + w G_{k+1}],    G_N = V(x_N),    w = e^(-dt / memory)

so every state on the way has a target, not only the first. It also has a target for the slope p_k = dG_k/dx, by the
chain rule through the closed loop, including the policy. With fixed controls, as in the costate of Pontryagin's
principle, the slopes of an unstable plant would grow backwards while the controls are not optimal. With a long memory
the targets are the policy's own cost. Its excess over the optimum is quadratic in the error of the policy, and the
iteration is Howard's policy iteration, which converges like Newton's method. With a short memory the targets are n-step
returns, which do not require a good policy.
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

from dln_jax.control.optimal.problem import (
    ControlProblem,
    Disturbance,
    ValueAndGradient,
    drawn,
    flow,
    optimal_control,
    widened,
)
from dln_jax.control.optimal.value_networks import ValueFit, ValueNetwork, ValueProgress
from dln_jax.process import held_back
from dln_jax.scale import local, program, spread
from dln_jax.types import InputError, Scalar, require_positive

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
    """Memory in the last iteration, s; infinite for the cost of the policy itself."""
    first_memory: float = 0.3
    """Memory in the first iteration, s."""
    kept: int = 8
    """Fitted states per trajectory: the first, and others at growing distances."""
    steps: int = 200
    """Adam steps per iteration."""
    batch: int = 1024
    learning_rate: float = 1e-2
    """Peak; it decays by a cosine over all iterations."""
    slope_weight: float = 0.05
    """Weight of the misfit of slopes, in units of the box, relative to the misfit of values."""
    floor: float = 0.02
    """Offset of the targets in relative misfits, as a share of their 90 % quantile."""
    followed: float = 2.0
    """Duration of validation runs, in units of `seconds`; V approximates the later costs."""
    margin: float = 1.25
    """Factor on the box for drawing states and clipping trajectories. The published value 1 lets the edges of the box
    affect the value inside."""


def fit_value(problem: ControlProblem, network: ValueNetwork, *, seed: int = 0, **options: Any) -> ValueFit:
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
    report: Callable[[int, ValueProgress], None] = lambda seed, progress: None,
    restore: Callable[[int, Any], tuple[Any, list[ValueProgress]] | None] = lambda seed, like: None,
    store: Callable[[int, Any, list[ValueProgress]], None] = lambda seed, state, history: None,
) -> list[ValueFit]:
    """Runs the iterations for several seeds, one after the other, in a program compiled once.

    The parameters of a seed are the best on separate validation states.

    Args:
        problem: the control problem.
        network: family of value functions.
        seeds: seeds of parameters and states.
        numbers: settings of the iteration.
        parameters: initial parameters; random by default.
        double: compute in float64, which takes twice as long.
        disturbance: worst-case disturbance, for a robust value.
        mesh: devices that share the runs of the policy; every device does the whole fit.
        report: called with the seed after every iteration.
        restore: (seed, first state) -> state and history for an exact resumption, or `None`. A state is a tree of the
            parameters, the optimiser's state and the best parameters.
        store: called with the seed, its state and its history after every iteration.

    Raises:
        InputError: a number is out of range, or the cost of the policy is never finite.
    """
    require_positive(**{name: number for name, number in numbers._asdict().items() if name != "slope_weight"})
    wide = widened(problem, numbers.margin)
    rate = optax.cosine_decay_schedule(numbers.learning_rate, numbers.iterations * numbers.steps, 0.01)
    adam = optax.adam(rate, b2=0.99)

    def begin(key: Array) -> tuple[Any, Any, Array]:
        """Returns parameters, state of the optimiser, and validation states."""
        start = network.init(jax.random.fold_in(key, 0)) if parameters is None else parameters
        start = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), start)
        return start, adam.init(start), drawn(wide, jax.random.fold_in(key, 1), VALIDATED)

    with jax.enable_x64(double):
        began, key = time.perf_counter(), jax.random.key(0)
        start, state, validated = begin(key)
        advance = program(_iteration(wide, network, numbers, adam, disturbance, mesh), mesh)
        advance = advance.lower(start, state, key, jnp.asarray(0.0)).compile()
        judge = program(_score(wide, network, numbers, disturbance, mesh), mesh).lower(start, validated).compile()
        compile_seconds = time.perf_counter() - began

        def fit(seed: int) -> ValueFit:
            began, key = time.perf_counter(), jax.random.key(seed)
            current, state, validated = begin(key)
            first = current, state, current
            (current, state, best), history = restore(seed, first) or (first, [])
            history, spent = list(history), history[-1].seconds if history else 0.0
            lowest = min((at.validation for at in history if math.isfinite(at.validation)), default=math.inf)
            for number in range(len(history), numbers.iterations):
                grown = number / max(numbers.iterations - 1, 1)
                memory = jnp.asarray(numbers.first_memory ** (1 - grown) * numbers.memory**grown)
                with held_back():  # an interrupt inside XLA is lost, or ends the process by SIGABRT
                    current, state, loss = advance(current, state, jax.random.fold_in(key, 2 + number), memory)
                    score = float(judge(current, validated))
                    if score < lowest:
                        best, lowest = current, score
                    passed = spent + time.perf_counter() - began
                    history.append(ValueProgress(number + 1, float(loss), score, passed, problem.discount))
                    store(seed, (current, state, best), list(history))
                report(seed, history[-1])
            if not math.isfinite(lowest):
                raise InputError(
                    "the cost of the policy was never finite; use a smaller dt, or a box that the policy can stay near"
                )
            return ValueFit(local(best, mesh), lowest, history, history[-1].seconds, compile_seconds)

        return [fit(seed) for seed in seeds]


def greedy(
    problem: ControlProblem, value: ValueAndGradient, dt: float, disturbance: Disturbance | None = None
) -> Callable[[Array], tuple[Array, Scalar]]:
    """Returns x -> state after a step of the greedy policy, and its cost, with the disturbance if any."""
    step = flow(problem, dt, clipped=True)

    def closed(x: Array) -> tuple[Array, Scalar]:
        slope = value(x)[1]
        u = optimal_control(problem, x, slope)
        return step(x, u, 0.0 if disturbance is None else disturbance(x, slope, u))

    return closed


def targets(
    problem: ControlProblem,
    value: ValueAndGradient,
    x: Array,
    *,
    steps: int,
    dt: float,
    memory: Any,
    disturbance: Disturbance | None = None,
) -> tuple[Array, Array, Array]:
    """Returns all states of the trajectory from x [n] except the last, and the targets of V and of its slope there.

    Args:
        problem: the control problem.
        value: the present value function.
        x: initial state.
        steps: N.
        dt: s.
        memory: memory of the weights, s.
        disturbance: worst disturbance, held over a step like the controls.
    """
    closed = greedy(problem, value, dt, disturbance)
    share, discount = jnp.exp(-dt / jnp.asarray(memory, x.dtype)), math.exp(-problem.discount * dt)

    def forward(x: Array, _: Any) -> tuple[Array, Array]:
        return closed(x)[0], x

    last, states = jax.lax.scan(forward, x, length=steps)

    def back(carry: tuple[Array, ...], x: Array) -> tuple[tuple[Array, ...], tuple[Array, Array]]:
        V_next, slope_next, G, p = carry
        (_, cost), pull_back = jax.vjp(closed, x)
        G = cost + discount * ((1 - share) * V_next + share * G)
        (p,) = pull_back((discount * ((1 - share) * slope_next + share * p), jnp.ones_like(cost)))
        return (*value(x), G, p), (G, p)

    V_end, slope_end = value(last)
    _, (G, p) = jax.lax.scan(back, (V_end, slope_end, V_end, slope_end), states, reverse=True)
    return states, G, p


def _iteration(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    adam: optax.GradientTransformation,
    disturbance: Disturbance | None,
    mesh: Mesh | None,
) -> Callable[[Any, Any, Array, Array], tuple[Any, Any, Array]]:
    """Returns one iteration: (parameters, optimiser's state, key, memory in s) -> the first two, and the mean loss."""
    half = jnp.asarray((np.asarray(problem.high) - np.asarray(problem.low)) / 2, float)
    steps = round(numbers.seconds / numbers.dt)
    index = np.unique((steps * (np.arange(numbers.kept) / numbers.kept) ** 2).astype(int))

    def of_start(parameters: Any, memory: Array, x: Array) -> tuple[Array, Array, Array]:
        value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
        return targets(problem, value, x, steps=steps, dt=numbers.dt, memory=memory, disturbance=disturbance)

    # Devices share the trajectories; every device does the whole fit.
    trajectories = spread(lambda shared, x: jax.vmap(functools.partial(of_start, *shared))(x), mesh)

    def iterate(parameters: Any, state: Any, key: Array, memory: Array) -> tuple[Any, Any, Array]:
        of_starts, of_batches = jax.random.split(key)
        rows = trajectories((parameters, memory), drawn(problem, of_starts, numbers.starts))
        data = jax.tree.map(lambda rows: rows[:, index].reshape(-1, *rows.shape[2:]), rows)
        largest = jnp.quantile(data[1], 0.9)

        def loss(parameters: Any, batch: tuple[Array, Array, Array]) -> Array:
            x, V_target, slope_target = batch
            V, slope = jax.vmap(lambda x: network.members(parameters, x))(x)
            size = (V_target + numbers.floor * largest)[:, None]
            off = (V - V_target[:, None]) / size
            off_slope = (slope - slope_target[:, None]) * half / size[..., None]
            return jnp.mean(_robust(off)) + numbers.slope_weight * jnp.mean(_robust(off_slope))

        def descend(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], Array]:
            parameters, state = carry
            batch = jax.tree.map(lambda rows: rows[jax.random.randint(key, (numbers.batch,), 0, len(rows))], data)
            value, gradient = jax.value_and_grad(loss)(parameters, batch)
            updates, state = adam.update(gradient, state, parameters)
            return (optax.apply_updates(parameters, updates), state), value

        keys = jax.random.split(of_batches, numbers.steps)
        (parameters, state), losses = jax.lax.scan(descend, (parameters, state), keys)
        return parameters, state, jnp.mean(losses)

    return iterate


def _robust(off: Array) -> Array:
    """Returns a loss that is quadratic for small and linear for large errors, because slopes jump at a ridge of V."""
    size = 0.1
    return size**2 * (jnp.sqrt(1 + (off / size) ** 2) - 1)


def _score(
    problem: ControlProblem,
    network: ValueNetwork,
    numbers: Iteration,
    disturbance: Disturbance | None,
    mesh: Mesh | None,
) -> Callable[[Any, Array], Array]:
    """Returns (parameters, states [N, n]) -> the mean cost of the policy, plus the mean of |V - cost|."""
    steps = round(numbers.followed * round(numbers.seconds / numbers.dt))
    discount = math.exp(-problem.discount * numbers.dt)

    def one(parameters: Any, x: Array) -> tuple[Array, Array]:
        value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
        closed = greedy(problem, value, numbers.dt, disturbance)

        def forward(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
            x, total, weight = carry
            after, cost = closed(x)
            return (after, total + weight * cost, weight * discount), None

        start = x, jnp.zeros((), x.dtype), jnp.ones((), x.dtype)
        (last, total, weight), _ = jax.lax.scan(forward, start, length=steps)
        return value(x)[0], total + weight * value(last)[0]

    def score(parameters: Any, x: Array) -> Array:
        V, cost = spread(jax.vmap(one, (None, 0)), mesh)(parameters, x)
        return jnp.mean(cost + jnp.abs(V - cost))

    return score
