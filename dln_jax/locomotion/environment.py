"""The task as a `gymnasium.Env`, for learners of other libraries: NumPy in float32, actions in [-1, 1]."""

from typing import Any

import gymnasium
import jax
import numpy as np
from jaxtyping import Float

from dln_jax.locomotion.task import FALLEN, LocomotionTask, advance, beginning, change_of, observe
from dln_jax.types import InputError


class CreatureEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """Environment of one creature, with the task's rewards.

    Actions in [-1, 1] are commands: the actuation approaches theirs by at most 0.3 per step. An episode is truncated
    after the task's number of steps. It is terminated by a fall, or by a step of the simulator that does not converge;
    `info["converged"]` distinguishes the two.
    """

    def __init__(self, task: LocomotionTask):
        self.task = task
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (task.observation_size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (task.muscle_count,), np.float32)
        self._place = beginning(task)
        self._begin = jax.jit(lambda key: beginning(task, key))
        self._advance = jax.jit(lambda place, action: advance(task, place, change_of(place.actuation, action)))
        self._observe = jax.jit(lambda place: observe(task, place))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " o"], dict[str, Any]]:
        """Returns the observation of a start perturbed by the task's variation; without one, at rest.

        Raises:
            InputError: there are options, of which this environment has none.
        """
        if options:
            raise InputError(f"reset got the options {', '.join(options)}; this environment has none")
        super().reset(seed=seed, options=options)
        self._place = self._begin(jax.random.key(int(self.np_random.integers(2**31))))
        return self._observation(), {}

    def step(
        self, action: Float[np.ndarray, " k"]
    ) -> tuple[Float[np.ndarray, " o"], float, bool, bool, dict[str, Any]]:
        """Returns observation, reward, terminated, truncated, and `info` with "x" [n, dim] in m and "converged"."""
        self._place, seen = self._advance(self._place, np.asarray(action, self._place.state.x.dtype))
        converged = bool(seen.converged)
        terminated = not converged or float(seen.tilt) > FALLEN
        truncated = int(self._place.steps) >= self.task.episode
        info = {"x": np.asarray(seen.x), "converged": converged}
        return self._observation(), float(seen.reward), terminated, truncated, info

    def _observation(self) -> Float[np.ndarray, " o"]:
        return np.asarray(self._observe(self._place), np.float32)
