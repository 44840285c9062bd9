"""Evaluates a policy from perturbed starts: how many episodes end without a fall, and how far they go."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from dln_jax.locomotion.learning import Parameters, Policy
from dln_jax.locomotion.task import LocomotionTask, beginning, run_episode

STARTS = 100
"""Number of episodes of an evaluation."""
STEPS = 2000
"""Number of steps of these episodes."""
LANES = 25
"""Number of episodes side by side."""
SEED = 1_000_000
"""Seed of the evaluation's starts, which training does not draw."""


class Trials(NamedTuple):
    """Results of n episodes."""

    distance: Float[np.ndarray, " n"]
    """Body lengths before a fall; NaN if a step did not converge."""
    steps: Int[np.ndarray, " n"]
    """Steps before a fall, or all."""
    ahead: Float[np.ndarray, " n"]
    """Gravity along x, in m/s²: positive downhill, negative uphill, 0 on level ground."""

    def standing(self, steps: int) -> Bool[np.ndarray, " n"]:
        """Returns which episodes of this many steps end without a fall."""
        return np.isfinite(self.distance) & (self.steps >= steps)


def perturbed_trials(
    task: LocomotionTask,
    policy: Policy,
    parameters: Parameters,
    *,
    starts: int = STARTS,
    steps: int = STEPS,
    seed: int = SEED,
) -> Trials:
    """Runs episodes from starts drawn by the task's variation, on its steepest slopes."""
    task = task._replace(episode=steps)

    def trial(parameters: Parameters, key: jax.Array):
        start = beginning(task, key, steepest=True)
        episode = run_episode(task, lambda seen: policy.apply(parameters, seen), start)
        return *episode, jnp.asarray(0.0) if start.world.gravity is None else start.world.gravity[0]

    keys = jax.random.split(jax.random.key(seed), starts)
    program = jax.jit(lambda parameters: jax.lax.map(lambda key: trial(parameters, key), keys, batch_size=LANES))
    return Trials(*map(np.asarray, program(parameters)))


def numbers_of(trials: Trials, steps: int = STEPS) -> dict[str, float]:
    """Returns metrics: episodes, those without a fall, and the distance of the median and of the worst episode.

    On slopes also the episodes without a fall, and distances, downhill and uphill.
    """
    standing = trials.standing(steps)
    numbers = {"perturbed_starts": float(len(standing)), "perturbed_steps": float(steps)}
    groups = {"": np.ones_like(standing), "_downhill": trials.ahead > 0, "_uphill": trials.ahead < 0}
    for name, group in groups.items():
        if not group.any():
            continue
        finite = trials.distance[group & np.isfinite(trials.distance)]
        if name:
            numbers[f"perturbed_starts{name}"] = float(group.sum())
        numbers[f"perturbed_without_fall{name}"] = float(standing[group].sum())
        if len(finite):
            numbers[f"perturbed_distance_body_lengths_median{name}"] = float(np.median(finite))
            numbers[f"perturbed_distance_body_lengths_least{name}"] = float(finite.min())
    return numbers
