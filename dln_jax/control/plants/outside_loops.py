"""Plants from outside: a Gymnasium environment, and the loop of your own hardware."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.types import InputError


def gymnasium_plant(
    env: Any,
    layout: Layout,
    coordinates: Callable[[Any], Any],
    *,
    action: Callable[[Any], Any] = lambda u: np.asarray(u, np.float32),
    seed: int = 0,
) -> Plant:
    """Returns a Gymnasium environment as a plant; rewards, `terminated` and `truncated` are ignored.

    Args:
        env: with `reset(seed=)` and `step(action)`; its start is near the layout's hanging posture.
        layout: layout of the plant; its rate is the step rate of the environment.
        coordinates: observation -> q [d]; angles may be wrapped.
        action: controls [m] -> action.
        seed: seed of the first reset.

    Raises:
        InputError: the environment has no reset or no step.
    """
    if not (callable(getattr(env, "reset", None)) and callable(getattr(env, "step", None))):
        raise InputError(f"env is a {type(env).__name__}; expected a Gymnasium environment with reset and step")
    state: dict[str, Any] = {"steps": 0, "seed": seed, "seen": None}

    def reset() -> None:
        state.update(steps=0, seen=env.reset(seed=state["seed"])[0], seed=None)

    def act(u: Any) -> None:
        state.update(steps=state["steps"] + 1, seen=env.step(action(u))[0])

    return Plant(layout, reset, lambda: coordinates(state["seen"]), act, lambda: state["steps"] / layout.rate)


def hardware_plant(
    layout: Layout,
    *,
    reset: Callable[[], None],
    read: Callable[[], Any],
    write: Callable[[Any], None],
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> Plant:
    """Returns hardware as a plant: `act` writes the controls and waits for the next sample of the clock.

    After a late sample the next one follows a period later; `guarded` stops the plant if a sample is too late.

    Args:
        layout: layout of the plant.
        reset: brings the plant to rest near hanging before it returns.
        read: () -> coordinates [d].
        write: (controls [m]) -> nothing.
        clock: () -> time, s.
        sleep: (s) -> nothing.
    """
    due = [0.0]

    def start() -> None:
        reset()
        due[0] = clock()

    def act(u: Any) -> None:
        write(u)
        due[0] = max(due[0] + 1 / layout.rate, clock())
        while (left := due[0] - clock()) > 0:
            sleep(left)

    return Plant(layout, start, read, act, clock)
