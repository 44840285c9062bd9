"""A plant with sensors and actuators as a `gymnasium.Env`, to train controllers with other libraries (extra `[rl]`).

Observations and actions are NumPy arrays in float32; actions in [-1, 1] are scaled to the limits of the controls. The
loop is that of `simulate`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Hardware, delivered, measured, noise_of
from dln_jax.control.state_space import Field, integrated
from dln_jax.types import InputError, JointKind, Scalar, require_positive


class _Place(NamedTuple):
    x: Array
    queue: Array
    """[delay, m], delayed controls."""
    number: Array


class PlantEnvironment(gymnasium.Env[np.ndarray, np.ndarray]):
    """Environment of one plant: actions in [-1, 1] span the control limits, the reward is minus the cost of a sample.

    Observations are the measurements of the hardware, with cosine and sine for revolute joints. An episode is
    truncated after `seconds`. It is terminated if state, observation or cost is not finite: `info["failed"]` is then
    true, the observation is the last finite one, and the reward is minus the cost of a failure. `info["x"]` is the true
    state, `info["u"]` the acting control.

    Args:
        field: (x, u) -> dx/dt of the plant, on x = (q, qd).
        cost: (x, u) -> cost per second at the start of a sample.
        start: key of jax.random -> x [2 d], drawn anew at every reset.
        joints: kinds of the joints [d].
        seconds: duration of an episode.
        rate: sampling rate, Hz.
        hardware: with finite limits, one per control or one for all.
        controls: m, number of controls.
        substeps: integrator steps per sample.
        failure_cost: cost of a failure; it should exceed the remaining cost of any other episode.

    Raises:
        InputError: a setting is not positive, a limit is not finite, or the delay is invalid.
    """

    def __init__(
        self,
        field: Field,
        cost: Callable[[Array, Array], Scalar],
        start: Callable[[Array], Array],
        joints: tuple[JointKind, ...],
        *,
        seconds: float,
        rate: float,
        hardware: Hardware,
        controls: int = 1,
        substeps: int = 1,
        failure_cost: float = 1e3,
    ):
        require_positive(seconds=seconds, rate=rate, controls=controls, substeps=substeps)
        low, high = (np.broadcast_to(np.asarray(limit, float), controls) for limit in hardware[:2])
        if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
            raise InputError(f"limits are {low} and {high}; expected finite ones in order, for actions in [-1, 1]")
        noise_of(hardware, jax.random.key(0))
        self._samples, self._failure_cost = round(seconds * rate), failure_cost
        self._key, self._place, self._seen = jax.random.key(0), None, np.zeros(0)
        step, revolute = integrated(field, 1 / rate, substeps=substeps), np.array(joints) == "revolute"
        turning, sliding = np.flatnonzero(revolute), np.flatnonzero(~revolute)

        def observe(x: Array, key: Array) -> Array:
            y = measured(hardware, x, key)
            angles, rates = y[turning], y[len(joints) :]
            return jnp.concatenate([y[sliding], jnp.cos(angles), jnp.sin(angles), rates])

        middle, half = jnp.asarray((low + high) / 2), jnp.asarray((high - low) / 2)

        @jax.jit
        def begin(key: Array) -> tuple[_Place, Array]:
            of_start, of_encoder = jax.random.split(jax.random.fold_in(key, 0))
            place = _Place(start(of_start), jnp.zeros((hardware.delay, controls)), jnp.asarray(1))
            return place, observe(place.x, of_encoder)

        @jax.jit
        def advance(key: Array, place: _Place, action: Array) -> tuple[_Place, Array, Array, Array]:
            of_control, of_encoder = jax.random.split(jax.random.fold_in(key, place.number))
            u, queue = delivered(hardware, place.queue, middle + half * action, of_control)
            after = _Place(step(place.x, u), queue, place.number + 1)
            return after, observe(after.x, of_encoder), cost(place.x, u) / rate, u

        self._begin, self._advance = begin, advance
        size = len(joints) + len(turning) + hardware.sees_rates * len(joints)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (controls,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " o"], dict[str, Any]]:
        """Draws an initial state and returns its observation; the seed determines it and all later noise."""
        super().reset(seed=seed, options=options)
        self._key = jax.random.key(int(self.np_random.integers(2**32)))
        self._place, seen = self._begin(self._key)
        self._seen = np.asarray(seen, np.float32)
        return self._seen, {"x": np.asarray(self._place.x)}

    def step(
        self, action: Float[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, " o"], float, bool, bool, dict[str, Any]]:
        """Returns observation, reward, terminated, truncated and `info`; raises `InputError` before the first reset."""
        if self._place is None:
            raise InputError("the environment has no state; call reset before step")
        after, seen, cost, u = self._advance(self._key, self._place, np.asarray(action, float))
        self._place, seen = after, np.asarray(seen, np.float32)
        failed = not (np.isfinite(after.x).all() and np.isfinite(seen).all() and np.isfinite(cost))
        self._seen = self._seen if failed else seen
        truncated = int(after.number) > self._samples and not failed
        info = {"x": np.asarray(after.x), "u": np.asarray(u), "failed": failed}
        return self._seen, -(self._failure_cost if failed else float(cost)), failed, truncated, info


def register(name: str, make: Callable[[], PlantEnvironment]) -> None:
    """Registers `make` with Gymnasium, so that `gymnasium.make(name)` calls it; nothing is registered by default.

    Args:
        name: name in Gymnasium's form, such as "dln_jax/CartPole-v0".
        make: builds the environment.
    """
    if name not in gymnasium.registry:
        gymnasium.register(id=name, entry_point=lambda **options: make(**options))
