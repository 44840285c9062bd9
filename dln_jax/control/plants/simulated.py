"""Plants from the step function of any simulator, with the noise, the resolution and the delay of hardware."""

from collections import deque
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from dln_jax.control.closed_loop import Hardware
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.state_space import field_of, integrated
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics

SPREAD = 0.1
"""Standard deviation of the passive coordinates at a start, rad or m."""
ACTIVE_SPREAD = 0.02
"""The same for the coordinates with a motor."""


def simulated(
    layout: Layout,
    begin: Callable[[np.ndarray], None],
    coordinates: Callable[[], Any],
    advance: Callable[[np.ndarray], None],
    *,
    kick: Callable[[np.ndarray], None] | None = None,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a plant that a simulator advances by one sample at a time, from random starts near hanging.

    Args:
        layout: layout of the plant, with the limits of the controls.
        begin: (posture [d]) -> nothing; puts the simulator there, at rest.
        coordinates: () -> the true q [d].
        advance: (controls that act [m]) -> nothing; advances the simulator by a sample.
        kick: (rates [d]) -> nothing; adds them to those of the simulator.
        hardware: noise, resolution and delay; its limits are not used.
        seed: seed of the starts and the noise.
    """
    random = np.random.default_rng([seed, 29])
    d, m = layout.actuation.shape
    step = np.broadcast_to(np.asarray(hardware.encoder_step, float), d)
    queue: deque[np.ndarray] = deque()
    count = [0]

    def reset() -> None:
        count[0] = 0
        queue.clear()
        queue.extend([np.zeros(m)] * hardware.delay)
        begin(layout.hanging + spread_of(layout) * random.normal(size=d))

    def read() -> np.ndarray:
        q = np.asarray(coordinates(), float) + hardware.encoder_noise * random.normal(size=d)
        return np.where(step > 0, step * np.round(q / np.where(step > 0, step, 1.0)), q)

    def act(u: Any) -> None:
        queue.append(np.asarray(u, float))
        advance(queue.popleft() + hardware.control_noise * random.normal(size=m))
        count[0] += 1

    return Plant(layout, reset, read, act, lambda: count[0] / layout.rate, kick)


def spread_of(layout: Layout) -> np.ndarray:
    """Returns the standard deviations of the coordinates at a start [d]."""
    return np.where((layout.actuation != 0).any(axis=1), ACTIVE_SPREAD, SPREAD)


def plant_of(
    model: Dynamics | PlainDynamics,
    layout: Layout,
    *,
    substeps: int = 2,
    hardware: Hardware = Hardware(),  # noqa: B008
    seed: int = 0,
) -> Plant:
    """Returns a plant that simulates a model of this library, such as that of a scene with friction.

    Args:
        model: for example `dynamics(scene.closed_form)`.
        layout: layout of the plant.
        substeps: Runge-Kutta steps per sample.
        hardware: as for `simulated`.
        seed: as for `simulated`.
    """
    step = jax.jit(integrated(field_of(model, layout.actuation), 1 / layout.rate, substeps=substeps))
    state = [np.zeros(2 * len(layout.joints))]

    def begin(q: np.ndarray) -> None:
        state[0] = np.concatenate([q, np.zeros_like(q)])

    def advance(u: np.ndarray) -> None:
        state[0] = np.asarray(step(state[0], u))

    def kick(rates: np.ndarray) -> None:
        state[0] = state[0] + np.concatenate([np.zeros_like(rates), rates])

    return simulated(
        layout, begin, lambda: state[0][: len(layout.joints)], advance, kick=kick, hardware=hardware, seed=seed
    )  # fmt: skip
