"""One iteration of continuous fitted value iteration: trajectories, their targets, the fit, and its score."""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.sharding import Mesh

from dln_jax.control.optimal.boxes import drawn
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.targets import Targets, greedy, targets
from dln_jax.control.optimal.value_networks import ValueNetwork
from dln_jax.control.optimal.worst_case import Disturbance
from dln_jax.scale.mesh import spread


class Iteration(NamedTuple):
    """Numbers of fitted value iteration."""

    iterations: int = 36
    starts: int = 1024
    """States drawn per iteration."""
    seconds: float = 3.0
    """Time in s for which the policy is followed from every state."""
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
    """Share of the largest target added to every target in relative misfits."""
    margin: float = 1.25
    """Factor on the box for drawing states and clipping trajectories; 1 as published, where the edges of the box affect
    the value inside."""


class Subject(NamedTuple):
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


def iterate(
    subject: Subject, adam: optax.GradientTransformation, parameters: Any, state: Any, key: Array, memory: Array
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
        batch = jax.tree.map(lambda each: each[jax.random.randint(key, (numbers.batch,), 0, len(data.V))], data)
        value, gradient = jax.value_and_grad(loss)(parameters, batch)
        updates, state = adam.update(gradient, state, parameters)
        return (optax.apply_updates(parameters, updates), state), value

    keys = jax.random.split(of_batches, numbers.steps)
    (parameters, state), losses = jax.lax.scan(descend, (parameters, state), keys)
    return parameters, state, jnp.mean(losses)


def _kept_targets(subject: Subject, parameters: Any, x: Array, memory: Array) -> Targets:
    """Targets at some states of the trajectories from x [N, n], one row per state."""

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
    found = trajectories((parameters, memory), x)
    kept = subject.numbers.kept
    index = np.unique((subject.steps * (np.arange(kept) / kept) ** 2).astype(int))
    return jax.tree.map(lambda each: each[:, index].reshape(-1, *each.shape[2:]), found)


def _robust(off: Array) -> Array:
    """Loss that is quadratic for small errors and linear for large ones, because slopes jump at a ridge of V."""
    size = 0.1
    return size**2 * (jnp.sqrt(1 + (off / size) ** 2) - 1)


def score(subject: Subject, parameters: Any, x: Array) -> Array:
    """Mean cost of the policy from states x [N, n], plus the mean of |V - cost|."""
    problem, network, dt = subject.problem, subject.network, subject.numbers.dt

    def one(parameters: Any, x: Array) -> tuple[Array, Array]:
        value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
        closed, discount = greedy(problem, value, dt, subject.disturbance), math.exp(-problem.discount * dt)

        def forward(carry: tuple[Array, Array, Array], _: Any) -> tuple[tuple[Array, Array, Array], None]:
            x, total, weight = carry
            after, cost = closed(x)
            return (after, total + weight * cost, weight * discount), None

        (last, total, weight), _ = jax.lax.scan(
            forward, (x, jnp.zeros((), x.dtype), jnp.ones((), x.dtype)), length=2 * subject.steps
        )
        return value(x)[0], total + weight * value(last)[0]

    V, cost = spread(jax.vmap(one, (None, 0)), subject.mesh)(parameters, x)
    return jnp.mean(cost + jnp.abs(V - cost))
