"""Evolution strategy with antithetic sampling and ranks (Salimans et al. 2017; Wierstra et al. 2014).

    g = 1 / (2 n sigma) sum_i (u_i+ - u_i-) eps_i,    eps_i ~ N(0, I)

u± are the fitnesses of theta ± sigma eps_i, or their centred ranks in [-1/2, 1/2], which are robust against outliers.
With fitnesses and many pairs g is the gradient of E[f(theta + sigma eps)], and of f if f is quadratic.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from dln_jax.locomotion.learning import LANES, Learner
from dln_jax.locomotion.policy import Policy
from dln_jax.locomotion.task import Task, run_episode
from dln_jax.scale.mesh import shares, spread
from dln_jax.types import require_positive


class EvolutionSettings(NamedTuple):
    """Settings of the strategy, the same for all creatures and seeds."""

    pairs: int = 16
    """n; a generation is 2 n episodes."""
    deviation: float = 0.2
    """sigma."""
    learning_rate: float = 0.2
    """Of Adam."""
    generations: int = 1
    """Between two evaluations."""

    @property
    def lanes(self) -> int:
        """Number of creatures simulated side by side."""
        return 2 * self.pairs


class EvolutionState(NamedTuple):
    """State of the search."""

    parameters: Any
    """Parameters of the policy, as a vector [p]."""
    optimiser: Any
    seed: Int[Array, ""]
    generation: Int[Array, ""]
    skipped: Int[Array, ""]


def estimate(
    plus: Float[Array, " n"], minus: Float[Array, " n"], noise: Float[Array, "n p"], deviation: float
) -> Float[Array, " p"]:
    """g from the fitnesses, or ranks, of theta + sigma eps and theta - sigma eps."""
    return (plus - minus) @ noise / (2.0 * deviation * len(noise))


def centred_ranks(fitness: Float[Array, " m"]) -> Float[Array, " m"]:
    """Ranks in ascending order, from -1/2 to 1/2; NaN ranks lowest."""
    order = jnp.argsort(jnp.argsort(jnp.where(jnp.isnan(fitness), -jnp.inf, fitness)))
    return order / (len(fitness) - 1) - 0.5


def make_evolution_learner(
    task: Task,
    policy: Policy,
    settings: EvolutionSettings = EvolutionSettings(),  # noqa: B008
    *,
    mesh: Mesh | None = None,
) -> Learner:
    """Returns the learner; episodes with a step that does not converge rank last and count as skipped.

    Raises:
        InputError: settings that are not positive, or a mesh that does not divide the lanes.
    """
    require_positive(**settings._asdict())
    shares(mesh, settings.lanes, LANES)
    like, unravel = ravel_pytree(policy.init(jax.random.key(0)))
    optimiser = optax.adam(settings.learning_rate)

    def start(seed: int) -> EvolutionState:
        parameters, _ = ravel_pytree(policy.init(jax.random.key(seed)))
        zero = jnp.asarray(0)
        return EvolutionState(parameters, optimiser.init(parameters), jnp.asarray(seed), zero, zero)

    def fitness(parameters: Float[Array, " p"]) -> Float[Array, ""]:
        return run_episode(task, lambda seen: policy.apply(unravel(parameters), seen)).total_reward

    fitnesses = spread(lambda theta, moves: jax.vmap(fitness)(theta + moves), mesh)

    def generation(state: EvolutionState, _: None) -> tuple[EvolutionState, None]:
        key = jax.random.fold_in(jax.random.key(state.seed), state.generation)
        noise = jax.random.normal(key, (settings.pairs, *like.shape), like.dtype)
        moves = settings.deviation * jnp.concatenate([noise, -noise])
        found = fitnesses(state.parameters, moves)
        plus, minus = jnp.split(centred_ranks(found), 2)
        gradient = estimate(plus, minus, noise, settings.deviation)
        change, moments = optimiser.update(-gradient, state.optimiser, state.parameters)
        moved, skipped = optax.apply_updates(state.parameters, change), state.skipped + jnp.isnan(found).sum()
        return EvolutionState(moved, moments, state.seed, state.generation + 1, skipped), None

    return Learner(
        policy=policy,
        start=start,
        improve=lambda state: jax.lax.scan(generation, state, length=settings.generations)[0],
        parameters=lambda state: unravel(state.parameters),
        steps=settings.generations * settings.lanes * task.episode,
    )
