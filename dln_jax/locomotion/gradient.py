"""Learns to move by short-horizon gradients through the simulator, with a learned value at the end of the horizon.

    J(theta) = E[ sum over t < H of gamma^t r_t  +  gamma^H V(o_H) ]  under theta + s eps,    eps ~ N(0, I)

Lanes come in pairs, +eps and -eps. Every lane walks H steps from the end of its last window, for episodes of any
length. Gradients go back to the beginning of the window and no further, so they neither explode nor vanish over an
episode; V stands for all later rewards (Xu et al. 2022, "Accelerated policy learning with parallel differentiable
simulation"). After a fall, the window's later rewards and value are zero, and the lane begins a new episode with a
start of its own. V is fitted to TD(lambda) targets, made by a copy V' that follows it slowly:

    G_t = r_t + gamma ((1 - lambda) V'(o_t+1) + lambda G_t+1),    G_H = V'(o_H)

A lane's gradient is clipped, and left out if it is not finite. The gradient is the mean over lanes in their order, so
it does not depend on their assignment to devices. The learning rate follows a cosine decay. The policy that is
evaluated and kept has running averages of the parameters, because single updates throw a gait off balance and back.
"""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Int

from dln_jax.locomotion.learning import (
    LANES,
    WIDTH,
    CompiledLearner,
    Goal,
    Learned,
    Learner,
    Parameters,
    Policy,
    Record,
    compile_learner,
    learn,
    make_policy,
    rank,
)
from dln_jax.locomotion.task import EpisodeState, LocomotionTask, Walk, advance, beginning, chosen, observe, walk
from dln_jax.locomotion.value import Window, make_value, targets
from dln_jax.scale import shares, spread
from dln_jax.types import InputError, require_positive

Report = Callable[[int, Record], None]


class GradientSettings(NamedTuple):
    """Settings of gradients and optimiser, the same for all creatures."""

    window: int = 32
    """H, number of steps that gradients go back."""
    lanes: int = 4
    """Number of creatures side by side."""
    deviation: float = 0.01
    """s, standard deviation of the parameters' perturbation."""
    learning_rate: float = 0.01
    """Initial learning rate of Adam for the policy."""
    last_rate: float = 0.03
    """Last learning rate relative to the first."""
    average: float = 0.99
    """Weight of the earlier parameters in their running average after an update."""
    value_learning_rate: float = 0.002
    """Learning rate of Adam for the value."""
    value_fits: int = 16
    """Adam steps for the value per update, on all lanes' windows."""
    discount: float = 0.99
    """gamma."""
    trace: float = 0.95
    """lambda."""
    following: float = 0.2
    """Share of the value that its copy adopts per update."""
    updates: int = 5
    """Updates between two evaluations by an episode from rest."""
    varied_updates: int = 100
    """Updates between two evaluations by several starts, which take longer."""


class GradientState(NamedTuple):
    """State of the training."""

    parameters: Parameters
    averaged: Parameters
    """Running averages of the parameters."""
    optimiser: Any
    value: Parameters
    value_optimiser: Any
    followed: Parameters
    """Copy of the value that makes the targets."""
    lanes: EpisodeState
    seed: Int[Array, ""]
    updates: Int[Array, ""]
    skipped: Int[Array, ""]


class TrainedPolicies(NamedTuple):
    """Policies of several seeds."""

    policy: Policy
    learned: list[Learned]

    @property
    def best(self) -> Learned:
        """The seed whose selected policy has the best evaluation."""
        return max(self.learned, key=lambda seed: rank(seed.selected))


def train(
    task: LocomotionTask,
    *,
    seeds: Sequence[int],
    goal: Goal,
    width: int = WIDTH,
    settings: GradientSettings = GradientSettings(),  # noqa: B008
    initial: Parameters | None = None,
    directory: Path | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
    report: Report = lambda seed, record: None,
) -> TrainedPolicies:
    """Trains with several seeds; settings are the same for all seeds and creatures.

    Args:
        seeds: seeds, trained one after the other; programs are compiled once.
        goal: conditions that end the training of a seed.
        width: width of the policy's hidden layer.
        settings: settings of the learner.
        initial: parameters of a policy of this width to train further (default: random).
        directory: folder where states are stored.
        resume: continue the runs stored there.
        mesh: devices that share the creatures simulated side by side.
        report: called with seed and record after every evaluation.

    Raises:
        InputError: settings are out of range, a stored run has others, or the mesh does not divide the creatures.
    """
    policy = make_policy(task, width=width)
    if initial is not None:
        policy = policy._replace(init=lambda _: initial)
    learner = make_gradient_learner(task, policy, settings, steps=goal.steps, mesh=mesh)
    facts = {"creature": task.creature.name, "width": width, "episode": task.episode, "steps": goal.steps}
    facts |= {"upright": task.upright, "speed": task.speed, "clock_period": task.clock_period}
    facts |= {**task.variation._asdict(), **settings._asdict()}
    compiled = compile_learner(task, learner, mesh)
    return learn_seeds(compiled, seeds, goal, report, directory=directory, settings=facts, resume=resume)


def learn_seeds(
    compiled: CompiledLearner, seeds: Sequence[int], goal: Goal, report: Report, **stored: Any
) -> TrainedPolicies:
    """Trains with several seeds by one compiled learner; `stored` are arguments of `learn` for checkpoints."""
    one = partial(learn, compiled, goal=goal, **stored)
    return TrainedPolicies(compiled.learner.policy, [one(seed=seed, report=partial(report, seed)) for seed in seeds])


def make_gradient_learner(
    task: LocomotionTask,
    policy: Policy,
    settings: GradientSettings = GradientSettings(),  # noqa: B008
    *,
    steps: int,
    mesh: Mesh | None = None,
) -> Learner:
    """Returns the learner, whose learning rate falls over `steps` environment steps.

    Raises:
        InputError: settings are out of range, or the mesh does not divide the lanes.
    """
    require_positive(**{**settings._asdict(), "deviation": settings.deviation or 1.0})
    shares(mesh, settings.lanes, LANES)
    if settings.lanes % 2:
        raise InputError(f"lanes is {settings.lanes}; the gradient takes creatures in pairs: give an even number")
    lanes, window, discount = settings.lanes, settings.window, settings.discount
    clipped = optax.clip_by_global_norm(1.0)
    in_all = max(1, steps // (lanes * window))
    rate = optax.cosine_decay_schedule(settings.learning_rate, in_all, settings.last_rate)
    optimiser = optax.adam(rate, b1=0.7, b2=0.95)
    value_init, value_of = make_value(task.observation_size)
    value_optimiser = optax.adam(settings.value_learning_rate)

    def start(seed: int) -> GradientState:
        parameters, value = policy.init(jax.random.key(seed)), value_init(jax.random.fold_in(jax.random.key(seed), 1))
        places = jax.vmap(lambda key: beginning(task, key))(jax.random.split(jax.random.key(seed), lanes))
        moments, zero = (optimiser.init(parameters), value_optimiser.init(value)), jnp.asarray(0)
        own = parameters, parameters, moments[0], value, moments[1], value, places
        return GradientState(*own, jnp.asarray(seed), zero, zero)

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
        records = Window(jnp.concatenate([seen, last[None]]), rewards, jnp.append(lived, alive))
        return -total, (end, records, converged.all())

    def descent(shared: tuple[Parameters, Parameters], own: tuple[Parameters, EpisodeState]) -> tuple[Any, Any]:
        gradient, (end, records, converged) = jax.grad(loss, has_aux=True)(*shared, *own)
        finite = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)]).all() & converged
        gradient, _ = clipped.update(
            jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), gradient), optax.EmptyState()
        )
        records = records._replace(alive=jnp.where(finite, records.alive, 0.0))
        return (gradient, finite), (end, jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), records))

    descents = spread(lambda shared, own: jax.vmap(partial(descent, shared))(own), mesh)

    def update(state: GradientState, _: None) -> tuple[GradientState, None]:
        key = jax.random.fold_in(jax.random.key(state.seed), state.updates)
        for_noise, for_starts = jax.random.split(key)
        shared = state.parameters, state.followed
        (gradients, finite), (ends, records) = descents(
            shared, (_opposite_pairs(for_noise, state.parameters, lanes), state.lanes)
        )
        gradient = jax.tree.map(lambda of_lanes: of_lanes.sum(axis=0) / jnp.maximum(finite.sum(), 1), gradients)
        change, moments = optimiser.update(gradient, state.optimiser, state.parameters)
        moved = optax.apply_updates(state.parameters, change)
        parameters, moments = chosen(finite.any(), (moved, moments), (state.parameters, state.optimiser))
        # The first averages cover few updates, so that they forget the initial parameters.
        kept = jnp.minimum(settings.average, (1.0 + state.updates) / (10.0 + state.updates))
        averaged = optax.incremental_update(parameters, state.averaged, 1.0 - kept)

        values = jax.vmap(jax.vmap(partial(value_of, state.followed)))(records.seen)
        aims = jax.vmap(partial(targets, discount=discount, trace=settings.trace))(records, values)
        counted = records.alive[:, :-1]

        def misfit(value: Parameters) -> Array:
            off = jax.vmap(jax.vmap(partial(value_of, value)))(records.seen[:, :-1]) - aims
            return jnp.sum(counted * off**2) / jnp.maximum(counted.sum(), 1.0)

        def fit(fitted: tuple[Parameters, Any], _: None) -> tuple[tuple[Parameters, Any], None]:
            value, moments = fitted
            change, moments = value_optimiser.update(jax.grad(misfit)(value), moments, value)
            return (optax.apply_updates(value, change), moments), None

        fitted = (state.value, state.value_optimiser)
        (value, value_moments), _ = jax.lax.scan(fit, fitted, length=settings.value_fits)
        followed = optax.incremental_update(value, state.followed, settings.following)
        over = (ends.steps >= task.episode) | (records.alive[:, -1] == 0)
        starts = jax.vmap(lambda key: beginning(task, key))(jax.random.split(for_starts, lanes))
        places = jax.vmap(chosen)(over, starts, ends)
        skipped = state.skipped + (~finite.all()).astype(state.skipped.dtype)
        learned = parameters, averaged, moments, value, value_moments, followed, places
        return GradientState(*learned, state.seed, state.updates + 1, skipped), None

    updates = settings.varied_updates if any(task.variation) else settings.updates
    return Learner(
        policy=policy,
        start=start,
        improve=lambda state: jax.lax.scan(update, state, length=updates)[0],
        parameters=lambda state: state.averaged,
        steps=updates * lanes * window,
    )


def _opposite_pairs(key: Array, parameters: Parameters, lanes: int) -> Parameters:
    """Returns normal noise of the parameters' shape for every lane; lanes of a pair have opposite noise."""
    leaves, structure = jax.tree.flatten(parameters)
    keys = jax.random.split(key, len(leaves))
    halves = [jax.random.normal(k, (lanes // 2, *leaf.shape), leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
    return structure.unflatten([jnp.concatenate([half, -half]) for half in halves])


def shown_walk(
    task: LocomotionTask, policy: Policy, parameters: Parameters, steps: int, seed: int | None = None
) -> Walk:
    """Runs a policy from rest, or from a start drawn by a seed, and returns its steps as NumPy arrays."""
    start = beginning(task, None if seed is None else jax.random.key(seed))
    program = jax.jit(lambda p: walk(task, lambda seen: policy.apply(p, seen), start, steps)[1])
    return jax.tree.map(np.asarray, program(parameters))
