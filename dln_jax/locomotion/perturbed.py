"""Evaluates a policy from perturbed starts: how many episodes end without a fall, and how far they go."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from dln_jax.locomotion.learning import Parameters, Policy
from dln_jax.locomotion.task import LocomotionTask, beginning, run_episode

STARTS = 100
"""Episodes of an evaluation."""
STEPS = 2000
"""Steps of its episodes."""
LANES = 25
"""Episodes side by side."""
SEED = 1_000_000
"""Of the evaluation's starts, which training does not draw."""


class Trials(NamedTuple):
    """Results of n episodes."""

    distance: Float[np.ndarray, " n"]
    """Body lengths before a fall; NaN if a step did not converge."""
    steps: Int[np.ndarray, " n"]
    """Steps before a fall, or all."""


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
        return run_episode(task, lambda seen: policy.apply(parameters, seen), start)

    keys = jax.random.split(jax.random.key(seed), starts)
    program = jax.jit(lambda parameters: jax.lax.map(lambda key: trial(parameters, key), keys, batch_size=LANES))
    return Trials(*map(np.asarray, program(parameters)))


def numbers_of(trials: Trials, steps: int = STEPS) -> dict[str, float]:
    """Metrics: episodes, those without a fall, and the distance of the median and of the worst episode."""
    finite = np.isfinite(trials.distance)
    reached = {"perturbed_distance_body_lengths_median": np.median, "perturbed_distance_body_lengths_least": np.min}
    distances = {name: float(of(trials.distance[finite])) for name, of in reached.items() if finite.any()}
    counts = {"perturbed_starts": len(finite), "perturbed_steps": steps}
    return {**counts, "perturbed_without_fall": float(np.sum(finite & (trials.steps >= steps))), **distances}
