"""Evolution strategy (Salimans et al. 2017) by evosax: antithetic samples and centred ranks, with Adam."""

import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float

from dln_jax.locomotion.gradient import Report, TrainedPolicies, learn_seeds
from dln_jax.locomotion.learning import LANES, Learner, Policy, compile_learner, make_policy
from dln_jax.locomotion.task import LocomotionTask, run_episode
from dln_jax.scale.mesh import shares, spread
from dln_jax.types import InputError

STEPS = 500_000
"""Environment steps by default."""


class EvolutionSettings(NamedTuple):
    """Settings, the same for all creatures and seeds."""

    lanes: int = 32
    """Creatures of a generation, in pairs."""
    deviation: float = 0.2
    learning_rate: float = 0.2
    """Learning rate of Adam."""


class EvolutionState(NamedTuple):
    """State of the search."""

    search: Any
    """State of evosax's algorithm."""
    seed: Array
    skipped: Array
    """Episodes with a step that did not converge; they rank last."""


def settings_of(lanes: int | None) -> EvolutionSettings:
    """Returns the settings, with another number of lanes if it is stated."""
    return EvolutionSettings() if lanes is None else EvolutionSettings(lanes=lanes)


def check(lanes: int | None, mesh: Mesh | None) -> None:
    """Raises `InputError` if evosax is not installed, or if the mesh does not divide the lanes."""
    if importlib.util.find_spec("evosax") is None:
        raise InputError("evolution needs evosax; install it by: pip install 'dln-jax[rivals]'")
    shares(mesh, settings_of(lanes).lanes, f"{LANES} (--lanes)")


def train_by_evolution(
    task: LocomotionTask, seeds: Sequence[int], goal: Any, report: Report, *, lanes: int | None, mesh: Mesh | None
) -> TrainedPolicies:
    """Learns with several seeds, without checkpoints; arguments as for `dln_jax.locomotion.train`."""
    learner = make_evolution_learner(task, make_policy(task), settings_of(lanes), mesh=mesh)
    return learn_seeds(compile_learner(task, learner, mesh), seeds, goal, report)


def make_evolution_learner(
    task: LocomotionTask, policy: Policy, settings: EvolutionSettings, *, mesh: Mesh | None = None
) -> Learner:
    """Returns the learner, of one generation per update; raises `InputError` as `check`."""
    check(settings.lanes, mesh)
    from evosax.algorithms import Open_ES  # pyright: ignore[reportMissingImports]

    constant = optax.constant_schedule(settings.deviation)
    like = policy.init(jax.random.key(0))
    strategy = Open_ES(settings.lanes, like, optimizer=optax.adam(settings.learning_rate), std_schedule=constant)

    def start(seed: int) -> EvolutionState:
        key = jax.random.key(seed)
        search = strategy.init(key, policy.init(key), strategy.default_params)
        return EvolutionState(search, jnp.asarray(seed), jnp.asarray(0))

    def cost(parameters: Any) -> Float[Array, ""]:
        return -run_episode(task, lambda observation: policy.apply(parameters, observation)).distance

    costs_of = spread(lambda _, population: jax.vmap(cost)(population), mesh)

    def improve(state: EvolutionState) -> EvolutionState:
        key = jax.random.fold_in(jax.random.key(state.seed), state.search.generation_counter)
        population, search = strategy.ask(key, state.search, strategy.default_params)
        costs = costs_of(None, population)
        search, _ = strategy.tell(key, population, costs, search, strategy.default_params)
        return EvolutionState(search, state.seed, state.skipped + jnp.isnan(costs).sum())

    return Learner(policy, start, improve, lambda state: strategy.get_mean(state.search), settings.lanes * task.episode)
