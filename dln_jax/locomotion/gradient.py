"""Learns locomotion by short-horizon gradients through the simulator, with a learned value at the horizon.

    command = tanh(W3 tanh(W1 body + W2 clock + b1) + b3)
    change of the actuation = 0.3 tanh((0.625 + 0.375 command - actuation) / 0.3)

    J(theta) = E[ sum over t < H of gamma^t r_t  +  gamma^H V(o_H) ]  under theta + s eps,    eps ~ N(0, I)

The policy's layers start with variances 0.3, 1 and 0.1 over their fan-in, so the muscles move little at first. Lanes
come in pairs, +eps and -eps. Every lane walks H steps from the end of its last window, for episodes of any length.
Gradients stop at the beginning of the window, so they neither explode nor vanish over an episode. V approximates all
later rewards (Xu et al. 2022, "Accelerated policy learning with parallel differentiable simulation"). After a fall, the
window's later rewards and value are zero, and the lane begins a new episode from a new start. V is fitted to TD(lambda)
targets from a slowly following copy V':

    G_t = r_t + gamma ((1 - lambda) V'(o_t+1) + lambda G_t+1),    G_H = V'(o_H)

A lane's gradient is clipped, and dropped if it is not finite. The gradient is the mean over lanes in their order, so it
does not depend on their assignment to devices. The learning rate follows a cosine decay. The evaluated policy uses
running averages of the parameters, because single updates can unbalance a gait.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import haiku as hk
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from dln_jax.errors import require_network
from dln_jax.locomotion.task import (
    EpisodeState,
    LocomotionTask,
    Walk,
    advance,
    beginning,
    change_of,
    observe,
    walk,
)
from dln_jax.scale import shares, spread
from dln_jax.softbody.substeps import where
from dln_jax.types import InputError, require_positive

WIDTH = 64
"""Number of hidden units of the policy, and of the two hidden layers of the value."""
LANES = "creatures side by side"
"""Name of the shared items in messages."""

Parameters = Any


class Policy(NamedTuple):
    """Policy as an (init, apply) pair."""

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    apply: Callable[[Parameters, Float[Array, " o"]], Float[Array, " k"]]
    """Observation -> change of the actuation."""


class GradientSettings(NamedTuple):
    """Settings of the policy, gradients and optimiser, the same for all creatures."""

    width: int = WIDTH
    """Width of the policy's hidden layer."""
    window: int = 32
    """H, number of steps in a gradient."""
    lanes: int = 4
    """Number of creatures side by side."""
    deviation: float = 0.01
    """s, standard deviation of the parameters' perturbation."""
    learning_rate: float = 0.01
    """Initial learning rate of Adam for the policy."""
    last_rate: float = 0.03
    """Last learning rate relative to the first."""
    average: float = 0.99
    """Weight of the old average in the running average after an update."""
    value_learning_rate: float = 0.002
    """Learning rate of Adam for the value."""
    value_fits: int = 16
    """Adam steps for the value per update, on the windows of all lanes."""
    discount: float = 0.99
    """gamma."""
    trace: float = 0.95
    """lambda."""
    following: float = 0.2
    """Share of the value in its copy per update."""
    updates: int = 5
    """Updates between two evaluations in an episode from rest."""
    varied_updates: int = 100
    """Updates between two evaluations from several starts, which take longer."""

    def updates_of(self, task: LocomotionTask) -> int:
        """Returns the number of updates between two evaluations."""
        return self.varied_updates if any(task.variation) else self.updates


class GradientState(NamedTuple):
    """State of the training."""

    parameters: Parameters
    averaged: Parameters
    """Running averages of the parameters: the evaluated policy."""
    optimiser: Any
    value: Parameters
    value_optimiser: Any
    followed: Parameters
    """Copy of the value for the targets."""
    lanes: EpisodeState
    seed: Int[Array, ""]
    updates: Int[Array, ""]
    skipped: Int[Array, ""]
    """Number of updates with a simulator step that did not converge."""


def make_policy(task: LocomotionTask, *, width: int = WIDTH) -> Policy:
    """Returns the policy of a task."""
    require_network(width=width, depth=1)

    def network(observation: Float[Array, " o"]) -> Float[Array, " k"]:
        scaled, split = hk.initializers.VarianceScaling, len(observation) - task.clock_size
        hidden = hk.Linear(width, w_init=scaled(0.3), name="body")(observation[:split])
        if task.clock_size:
            hidden += hk.Linear(width, with_bias=False, w_init=scaled(1.0), name="clock")(observation[split:])
        muscles = hk.Linear(task.muscle_count, w_init=scaled(0.1), name="muscles")
        actuation = observation[split - task.muscle_count : split]
        return change_of(actuation, jnp.tanh(muscles(jnp.tanh(hidden))))

    transformed = hk.without_apply_rng(hk.transform(network))
    return Policy(lambda key: transformed.init(key, observe(task, beginning(task))), transformed.apply)


def shown_walk(
    task: LocomotionTask, policy: Policy, parameters: Parameters, steps: int, seed: int | None = None
) -> Walk:
    """Runs a policy from rest, or from a random start of a seed, and returns its steps as NumPy arrays."""
    start = beginning(task, None if seed is None else jax.random.key(seed))
    program = jax.jit(lambda p: walk(task, lambda seen: policy.apply(p, seen), start, steps)[1])
    return jax.tree.map(np.asarray, program(parameters))


def make_updates(
    task: LocomotionTask, policy: Policy, settings: GradientSettings, *, steps: int, mesh: Mesh | None = None
) -> tuple[Callable[[int], GradientState], Callable[[GradientState], GradientState]]:
    """Returns seed -> state, and state -> state after the updates between two evaluations.

    The learning rate falls over `steps` environment steps.

    Raises:
        InputError: settings are out of range, or the mesh does not divide the lanes.
    """
    require_positive(**{**settings._asdict(), "deviation": settings.deviation or 1.0})
    shares(mesh, settings.lanes, LANES)
    if settings.lanes % 2:
        raise InputError(f"lanes is {settings.lanes}; the gradient needs pairs of creatures: choose an even number")
    lanes, window, discount = settings.lanes, settings.window, settings.discount
    clipped = optax.clip_by_global_norm(1.0)
    in_all = max(1, steps // (lanes * window))
    rate = optax.cosine_decay_schedule(settings.learning_rate, in_all, settings.last_rate)
    optimiser = optax.adam(rate, b1=0.7, b2=0.95)
    value_optimiser = optax.adam(settings.value_learning_rate)

    def value_network(seen: Float[Array, " o"]) -> Float[Array, ""]:
        return hk.nets.MLP([WIDTH, WIDTH, 1], activation=jnp.tanh, name="value")(seen)[0]

    value_init, value_of = hk.without_apply_rng(hk.transform(value_network))

    def start(seed: int) -> GradientState:
        key, zero = jax.random.key(seed), jnp.asarray(0)
        parameters = policy.init(key)
        value = value_init(jax.random.fold_in(key, 1), jnp.zeros(task.observation_size))
        places = jax.vmap(lambda key: beginning(task, key))(jax.random.split(key, lanes))
        return GradientState(
            parameters,
            parameters,
            optimiser.init(parameters),
            value,
            value_optimiser.init(value),
            value,
            places,
            jnp.asarray(seed),
            zero,
            zero,
        )

    def loss(parameters: Parameters, value: Parameters, noise: Parameters, place: EpisodeState) -> tuple[Array, Any]:
        own = jax.tree.map(lambda p, eps: p + settings.deviation * eps, parameters, noise)

        def one(carry: tuple[EpisodeState, Array], _: None) -> tuple[Any, Any]:
            place, alive = carry
            seen = observe(task, place)
            place, at = advance(task, place, policy.apply(own, seen))
            standing = alive * jnp.where(at.lost, 0.0, 1.0)
            return (place, standing), (seen, at.reward, alive, at.converged)

        (end, alive), (seen, rewards, lived, converged) = jax.lax.scan(one, (place, jnp.ones(())), length=window)
        last = observe(task, end)
        weights = discount ** jnp.arange(window)
        later = jnp.where(alive > 0, discount**window * value_of(value, last), 0.0)
        total = jnp.sum(weights * jnp.where(lived > 0, rewards, 0.0)) + later
        records = jnp.concatenate([seen, last[None]]), rewards, jnp.append(lived, alive)
        return -total, (end, records, converged.all())

    def descent(shared: tuple[Parameters, Parameters], own: tuple[Parameters, EpisodeState]) -> tuple[Any, Any]:
        gradient, (end, (seen, rewards, alive), converged) = jax.grad(loss, has_aux=True)(*shared, *own)
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)]).all() & converged
        gradient, seen, rewards, alive = jax.tree.map(
            lambda leaf: jnp.where(finite, leaf, 0.0), (gradient, seen, rewards, alive)
        )
        return (clipped.update(gradient, optax.EmptyState())[0], finite), (end, seen, rewards, alive)

    descents = spread(lambda shared, own: jax.vmap(partial(descent, shared))(own), mesh)

    def update(state: GradientState, _: None) -> tuple[GradientState, None]:
        key = jax.random.fold_in(jax.random.key(state.seed), state.updates)
        for_noise, for_starts = jax.random.split(key)
        leaves, structure = jax.tree.flatten(state.parameters)
        keys = zip(leaves, jax.random.split(for_noise, len(leaves)), strict=True)
        halves = [jax.random.normal(key, (lanes // 2, *leaf.shape), leaf.dtype) for leaf, key in keys]
        # Lanes of a pair have opposite noise.
        noise = structure.unflatten([jnp.concatenate([half, -half]) for half in halves])
        (gradients, finite), (ends, seen, rewards, alive) = descents(
            (state.parameters, state.followed), (noise, state.lanes)
        )
        gradient = jax.tree.map(lambda of_lanes: of_lanes.sum(axis=0) / jnp.maximum(finite.sum(), 1), gradients)
        change, moments = optimiser.update(gradient, state.optimiser, state.parameters)
        moved = optax.apply_updates(state.parameters, change)
        parameters, moments = where(finite.any(), (moved, moments), (state.parameters, state.optimiser))
        # The first averages cover few updates, to forget the initial parameters.
        kept = jnp.minimum(settings.average, (1.0 + state.updates) / (10.0 + state.updates))
        averaged = optax.incremental_update(parameters, state.averaged, 1.0 - kept)

        values = jax.vmap(jax.vmap(partial(value_of, state.followed)))(seen)
        aims = jax.vmap(partial(targets, discount=discount, trace=settings.trace))(rewards, alive, values)
        counted = alive[:, :-1]

        def misfit(value: Parameters) -> Array:
            off = jax.vmap(jax.vmap(partial(value_of, value)))(seen[:, :-1]) - aims
            return jnp.sum(counted * off**2) / jnp.maximum(counted.sum(), 1.0)

        def fit(fitted: tuple[Parameters, Any], _: None) -> tuple[tuple[Parameters, Any], None]:
            value, moments = fitted
            change, moments = value_optimiser.update(jax.grad(misfit)(value), moments, value)
            return (optax.apply_updates(value, change), moments), None

        fitted = (state.value, state.value_optimiser)
        (value, value_moments), _ = jax.lax.scan(fit, fitted, length=settings.value_fits)
        followed = optax.incremental_update(value, state.followed, settings.following)
        over = (ends.steps >= task.episode) | (alive[:, -1] == 0)
        starts = jax.vmap(lambda key: beginning(task, key))(jax.random.split(for_starts, lanes))
        places = jax.vmap(where)(over, starts, ends)
        skipped = state.skipped + (~finite.all()).astype(state.skipped.dtype)
        learned = parameters, averaged, moments, value, value_moments, followed, places
        return GradientState(*learned, state.seed, state.updates + 1, skipped), None

    return start, lambda state: jax.lax.scan(update, state, length=settings.updates_of(task))[0]


def targets(
    rewards: Float[Array, " H"],
    alive: Float[Array, " H_plus_1"],
    values: Float[Array, " H_plus_1"],
    discount: float,
    trace: float,
) -> Float[Array, " H"]:
    """Returns TD(lambda) targets G_t of a window; `values` are V' of its observations; alive is 1 before a fall."""
    values = alive * values

    def back(later: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        reward, value = at
        target = reward + discount * ((1 - trace) * value + trace * later)
        return target, target

    return jax.lax.scan(back, values[-1], (alive[:-1] * rewards, values[1:]), reverse=True)[1]
