"""Many creatures at once for stable-baselines3: one compiled, vmapped step that also restarts lanes."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

from dln_jax.locomotion.environment import spaces
from dln_jax.locomotion.learning import LANES
from dln_jax.locomotion.task import (
    EpisodeState,
    LocomotionTask,
    advance,
    beginning,
    change_of,
    chosen,
    observe,
)
from dln_jax.scale.mesh import program, shares, spread


class VectorEnvironment(VecEnv):
    """Lanes of `CreatureEnvironment`, with rewards times a constant; devices of a mesh share them.

    Raises `InputError` for a mesh that does not divide the lanes.
    """

    def __init__(self, task: LocomotionTask, lanes: int, *, reward_scale: float = 1.0, mesh: Mesh | None = None):
        shares(mesh, lanes, LANES)
        self.render_mode = None
        super().__init__(lanes, *spaces(task))
        self._scale = reward_scale
        self._start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (lanes, *leaf.shape)), beginning(task))
        self._places, self._actions = self._start, np.zeros((lanes, task.muscle_count), np.float32)

        def one(place: EpisodeState, action: Any) -> tuple[EpisodeState, Any]:
            after, seen = advance(task, place, change_of(place.actuation, action))
            terminated = seen.lost
            truncated = (after.steps >= task.episode) & ~terminated
            kept = chosen(terminated | truncated, beginning(task), after)
            last, first = observe(task, after).astype(jnp.float32), observe(task, kept).astype(jnp.float32)
            return kept, (first, seen.reward.astype(jnp.float32), terminated, truncated, last)

        actions = jnp.zeros(self._actions.shape, self._places.state.x.dtype)
        advanced = spread(lambda _, lanes: jax.vmap(one)(*lanes), mesh)
        stepped = program(lambda places, actions: advanced(None, (places, actions)), mesh)
        self._advance = stepped.lower(self._places, actions).compile()
        self._first = np.asarray(jax.jit(jax.vmap(lambda place: observe(task, place)))(self._start), np.float32)

    def reset(self) -> np.ndarray:
        """Starts an episode in all lanes and returns their observations."""
        self._places = self._start
        return self._first.copy()

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Steps all lanes and restarts those that ended, with their last observation in their info."""
        actions = np.asarray(self._actions, self._places.state.x.dtype)
        self._places, seen = self._advance(self._places, actions)
        observed, rewards, terminated, truncated, last = (np.asarray(values) for values in seen)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for lane in np.flatnonzero(terminated | truncated):
            infos[lane] = {"terminal_observation": last[lane], "TimeLimit.truncated": bool(truncated[lane])}
        return observed.copy(), self._scale * rewards, terminated | truncated, infos

    def close(self) -> None:
        """Does nothing, because nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the attribute once per lane."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets the attribute for all lanes."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **keywords: Any) -> list[Any]:
        """Calls the method, which all lanes share, once per lane."""
        return [getattr(self, method_name)(*arguments, **keywords) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns False for every lane."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns None for every lane, because images are not drawn."""
        return [None] * self.num_envs
