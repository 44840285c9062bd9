"""Learns to move by short-horizon gradients through the simulator, of a smoothed objective.

    J(theta) = E[ reward of a window of H steps under theta + sigma eps ],    eps ~ N(0, I)

Every lane walks H steps from the end of its last window, with its own parameters. Gradients go back to the beginning of
the window and no further, so that they neither explode nor vanish over the length of an episode (Xu et al. 2022,
"Accelerated policy learning with parallel differentiable simulation"). Windows are longer than the clock's period: they
include the effect of a step on the next stride, and no value function is needed. Lanes come in pairs, +eps and -eps.
The gradient is the mean over lanes in their order, so that it does not depend on their assignment to devices.
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
)
from dln_jax.locomotion.task import FALLEN, EpisodeState, LocomotionTask, Walk, beginning, chosen, walk
from dln_jax.scale.mesh import shares, spread
from dln_jax.types import InputError, require_positive

BALANCING = {"biped": 80}
"""Windows of creatures that need one longer than the default: balance on two legs needs the whole episode."""

Report = Callable[[int, Record], None]


class GradientSettings(NamedTuple):
    """Settings of the gradients and of their descent."""

    window: int = 40
    """Steps that gradients go back; divides the episode."""
    pairs: int = 1
    """Half of the number of lanes."""
    deviation: float = 0.01
    """sigma; 0 takes the plain objective."""
    learning_rate: float = 0.02
    """Of Adam, after clipping the gradient's norm at 1 body length per episode."""
    updates: int = 5
    """Between two evaluations."""

    @property
    def lanes(self) -> int:
        """Number of creatures simulated side by side."""
        return 2 * self.pairs


class GradientState(NamedTuple):
    """State of the learning."""

    parameters: Parameters
    optimiser: Any
    lanes: EpisodeState
    """States of the lanes."""
    seed: Int[Array, ""]
    updates: Int[Array, ""]
    skipped: Int[Array, ""]


class TrainedPolicies(NamedTuple):
    """Policies of several seeds."""

    policy: Policy
    learned: list[Learned]

    @property
    def best(self) -> Learned:
        """The seed with the longest distance."""
        return max(self.learned, key=lambda seed: seed.distance if np.isfinite(seed.distance) else -np.inf)


def settings_of(task: LocomotionTask, window: int | None = None, lanes: int | None = None) -> GradientSettings:
    """Returns the settings for a creature; only the window depends on it.

    Raises:
        InputError: a window that does not divide the episode, or an odd number of lanes.
    """
    settings = GradientSettings()
    window = window or BALANCING.get(task.creature.name, settings.window)
    lanes = settings.lanes if lanes is None else lanes
    if lanes % 2:
        raise InputError(f"{lanes} creatures are no pairs, in which the gradient takes them; give an even number")
    if task.episode % window:
        raise InputError(f"a window has {window} steps; expected a divisor of the episode's {task.episode}")
    return settings._replace(window=window, pairs=lanes // 2)


def train(
    task: LocomotionTask,
    *,
    seeds: Sequence[int],
    goal: Goal,
    width: int = WIDTH,
    window: int | None = None,
    lanes: int | None = None,
    directory: Path | None = None,
    resume: bool = False,
    mesh: Mesh | None = None,
    report: Report = lambda seed, record: None,
) -> TrainedPolicies:
    """Learns with several seeds; settings are the same for all seeds and, except the window, for all creatures.

    Args:
        task: to learn.
        seeds: trained one after the other; programs are compiled once.
        goal: conditions that end the learning of a seed.
        width: of the hidden layer of the policy.
        window: steps that gradients go back, a divisor of the episode (default: 40, for the biped 80).
        lanes: creatures side by side, an even number (default: 2).
        directory: where states are stored.
        resume: continue the runs stored there.
        mesh: devices that share the creatures simulated side by side.
        report: called with seed and record after every evaluation.

    Raises:
        InputError: settings out of range, a stored run with others, or a mesh that does not divide the creatures.
    """
    settings = settings_of(task, window, lanes)
    learner = make_gradient_learner(task, make_policy(task, width=width), settings, mesh=mesh)
    facts = {"creature": task.creature.name, "width": width, "episode": task.episode}
    facts |= {"clock_period": task.clock_period, "upright": task.upright, **settings._asdict()}
    compiled = compile_learner(task, learner, mesh)
    return learn_seeds(compiled, seeds, goal, report, directory=directory, settings=facts, resume=resume)


def learn_seeds(
    compiled: CompiledLearner, seeds: Sequence[int], goal: Goal, report: Report, **stored: Any
) -> TrainedPolicies:
    """Learns with several seeds by one compiled learner; `stored` are arguments of `learn` on checkpoints."""
    one = partial(learn, compiled, goal=goal, **stored)
    return TrainedPolicies(compiled.learner.policy, [one(seed=seed, report=partial(report, seed)) for seed in seeds])


def make_gradient_learner(
    task: LocomotionTask,
    policy: Policy,
    settings: GradientSettings = GradientSettings(),  # noqa: B008
    *,
    mesh: Mesh | None = None,
) -> Learner:
    """Returns the learner; raises `InputError` for settings out of range, or a mesh that does not divide the lanes."""
    require_positive(**{**settings._asdict(), "deviation": settings.deviation or 1.0})
    shares(mesh, settings.lanes, LANES)
    lanes, window = settings.lanes, settings.window
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(settings.learning_rate, b2=0.95))

    def start(seed: int) -> GradientState:
        parameters = policy.init(jax.random.key(seed))
        # Lanes start in different parts of the episode, so that every update sees several.
        counts = jnp.arange(lanes) * window % task.episode
        places = jax.vmap(lambda steps: beginning(task)._replace(steps=steps))(counts)
        zero = jnp.asarray(0)
        return GradientState(parameters, optimiser.init(parameters), places, jnp.asarray(seed), zero, zero)

    def loss(parameters: Parameters, sign: Array, noise: Parameters, place: EpisodeState) -> tuple[Array, Any]:
        own = jax.tree.map(lambda p, eps: p + sign * settings.deviation * eps, parameters, noise)
        end, seen = walk(task, lambda observation: policy.apply(own, observation), place, window)
        usable = seen.converged.all() & (jnp.abs(seen.tilt[-1]) < FALLEN)
        return -seen.reward.sum() * task.episode / window, (end, usable)

    of_lanes = jax.vmap(jax.grad(loss, has_aux=True), (None, 0, 0, 0))
    descents = spread(lambda parameters, lanes: of_lanes(parameters, *lanes), mesh)
    signs = jnp.tile(jnp.asarray([1.0, -1.0]), settings.pairs)

    def update(state: GradientState, _: None) -> tuple[GradientState, None]:
        key = jax.random.fold_in(jax.random.key(state.seed), state.updates)
        noise = _pairs_of_noise(key, state.parameters, settings.pairs)
        gradients, (ends, usable_ends) = descents(state.parameters, (signs, noise, state.lanes))
        gradient = jax.tree.map(lambda of_lanes: of_lanes.mean(axis=0), gradients)
        # A step that does not converge has NaN as its gradient.
        usable = jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient)]).all()
        change, moments = optimiser.update(gradient, state.optimiser, state.parameters)
        moved = optax.apply_updates(state.parameters, change)
        parameters, moments = chosen(usable, (moved, moments), (state.parameters, state.optimiser))
        over = (ends.steps >= task.episode) | ~usable_ends
        lanes = jax.vmap(lambda over, end: chosen(over, beginning(task), end))(over, ends)
        skipped = state.skipped + (~usable).astype(state.skipped.dtype)
        return GradientState(parameters, moments, lanes, state.seed, state.updates + 1, skipped), None

    return Learner(
        policy=policy,
        start=start,
        improve=lambda state: jax.lax.scan(update, state, length=settings.updates)[0],
        parameters=lambda state: state.parameters,
        steps=settings.updates * lanes * window,
    )


def _pairs_of_noise(key: Array, like: Parameters, pairs: int) -> Parameters:
    """Normal numbers that are the same for the two lanes of a pair."""
    leaves, structure = jax.tree.flatten(like)
    keys = jax.random.split(key, len(leaves))
    drawn = [jax.random.normal(k, (pairs, *leaf.shape), leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
    return structure.unflatten([jnp.repeat(noise, 2, axis=0) for noise in drawn])


def shown_walk(task: LocomotionTask, policy: Policy, parameters: Parameters, steps: int) -> Walk:
    """Runs a policy from rest and returns its steps as NumPy arrays."""
    program = jax.jit(lambda p: walk(task, lambda seen: policy.apply(p, seen), beginning(task), steps)[1])
    return jax.tree.map(np.asarray, program(parameters))
