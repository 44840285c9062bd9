"""Closed loop of callable plants: one plant, or several in step with one call of the controller for all.

A plant is stopped if it leaves its limits of position, rate or control, or if an answer is late or not finite.
"""

import gc
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from dln_jax.control.closed_loop import Controller, Push
from dln_jax.control.plants.plant import Layout, Plant
from dln_jax.control.state_space import saturated
from dln_jax.types import InputError, require_positive

TOLERANCE = 0.2
"""Largest distance of an angle from the goal that counts as up, rad."""
HELD = 1.0
"""A plant must stay up for this time at the end, s."""

NEAR = 1.0
"""Largest angle of a passive joint from hanging at a start, rad: a standing pole is refused."""
SPAN = 5
"""Number of samples for measuring a rate, so that an encoder step does not look like a high rate."""
ROUNDING = 1e-9


Act = Callable[[Any, Any, Any], tuple[Any, Any]]
"""(memories, times since the first measurements [n], measurements [n, d]) -> (memories, controls [n, m]), compiled."""


class PlantRun(NamedTuple):
    """Measurements and commands of N samples; fewer than requested if the plant was stopped."""

    t: Float[np.ndarray, " N"]
    """Times of the measurements since the first one, by the plant's clock, s: hardware is never exactly on time."""
    y: Float[np.ndarray, "N d"]
    u: Float[np.ndarray, "N m"]
    """Commands, within the limits."""
    stopped: str = ""
    """Reason for a stop; empty without one."""


class Stopped(RuntimeError):
    """The plant was stopped, with zero controls; the message gives the reason. It acts again after a reset."""


def guarded(plant: Plant) -> Plant:
    """Wraps a plant so that it stops, with zero controls and `Stopped`, outside its limits or after a wrong answer.

    Measured angles may be wrapped; the guarded plant unwraps them. Its time is the time of the last answer. The reset
    raises `InputError` for a start outside the limits or far from hanging, or an answer of another shape.
    """
    layout, limits = plant.layout, plant.layout.limits
    d, m = layout.actuation.shape
    circular = np.array([kind == "revolute" for kind in layout.joints])
    swinging = circular & ~(layout.actuation != 0).any(axis=1)
    seen: deque[tuple[float, np.ndarray]] = deque(maxlen=SPAN + 1)
    reason: list[str] = []
    acted = [False]

    def stop(why: str) -> None:
        if not reason:
            reason.append(why)
            plant.act(np.zeros(m))
        raise Stopped(reason[0])

    def answer() -> np.ndarray:
        q = np.asarray(plant.read(), float)
        if q.shape != (d,):
            raise InputError(f"the plant answers {q.shape}; expected {d} coordinates")
        if seen:
            before = seen[-1][1]
            turned = before + np.remainder(q - before + np.pi, 2 * np.pi) - np.pi
            return np.where(circular, turned, q)
        # The first answer is the turn nearest to hanging.
        near = layout.hanging + np.remainder(q - layout.hanging + np.pi, 2 * np.pi) - np.pi
        return np.where(circular, near, q)

    def outside(q: np.ndarray, rates: np.ndarray) -> str:
        for k, name in enumerate(layout.names):
            lower, upper = limits.position[k]
            if not lower <= q[k] <= upper:
                return f"'{name}' is at {q[k]:.4g}, outside {lower:.4g} to {upper:.4g}"
            ahead = q[k] + limits.stopping * rates[k]
            if not lower <= ahead <= upper:
                return (
                    f"'{name}' moves from {q[k]:.4g} at {rates[k]:.4g}/s towards its limits {lower:.4g} to {upper:.4g}"
                )
            if abs(rates[k]) > limits.rate[k]:
                return f"'{name}' moves at {abs(rates[k]):.4g}/s, faster than {limits.rate[k]:.4g}/s"
        return ""

    def reset() -> None:
        reason.clear()
        seen.clear()
        acted[0] = False
        plant.reset()
        q = answer()
        if not np.isfinite(q).all():
            raise InputError(f"the plant starts at {q.tolist()}; expected finite coordinates: check its sensors")
        if why := outside(q, np.zeros(d)):
            raise InputError(f"{why}: the start is outside the limits; reset the plant to a posture inside")
        away = np.where(swinging, np.abs(q - layout.hanging), 0.0)
        if away.max() > NEAR:
            raise InputError(
                f"'{layout.names[int(np.argmax(away))]}' starts {away.max():.3g} rad from hanging; expected at most "
                f"{NEAR:g}: let the reset wait until the plant rests there, or check `hanging` in the layout"
            )
        seen.append((plant.time(), q))

    def read() -> np.ndarray:
        if reason:
            raise Stopped(reason[0])
        if not seen:
            raise InputError("the plant has no start; call reset first")
        q, t = answer(), plant.time()
        if not np.isfinite(q).all() or not math.isfinite(t):
            stop(f"the plant answers {q.tolist()} at the time {t}, which is not finite")
        if acted[0] and t <= seen[-1][0]:
            stop(
                f"the plant's clock reads {t:.6g} s after {seen[-1][0]:.6g} s; expected it to advance with every sample"
            )
        if t - seen[-1][0] > limits.late / layout.rate:
            stop(f"an answer is {1e3 * (t - seen[-1][0]):.4g} ms after the last, more than {limits.late:g} samples")
        seen.append((t, q))
        acted[0] = False
        passed = t - seen[0][0]
        rates = (q - seen[0][1]) / passed if passed > 0 else np.zeros(d)
        if why := outside(q, rates):
            stop(why)
        return q

    def act(u: Any) -> None:
        if reason:
            raise Stopped(reason[0])
        u = np.asarray(u, float)
        slack = ROUNDING * (limits.control[:, 1] - limits.control[:, 0])
        if u.shape != (m,) or not np.isfinite(u).all():
            stop(f"the controls are {u.tolist()}; expected {m} finite numbers")
        if (u < limits.control[:, 0] - slack).any() or (u > limits.control[:, 1] + slack).any():
            stop(f"the controls are {u.tolist()}, outside {limits.control.tolist()}")
        plant.act(u)
        acted[0] = True

    return plant._replace(reset=reset, read=read, act=act, time=lambda: seen[-1][0] if seen else plant.time())


def compiled(controller: Controller, layout: Layout) -> Act:
    """Compiles a controller for a batch of memories, with its controls within the limits."""
    lower, upper = layout.limits.control.T

    def act(memory: Any, t: Any, y: Any) -> tuple[Any, Any]:
        memory, u = controller.act(memory, t, y)
        return memory, saturated(u, lower, upper)

    return jax.jit(jax.vmap(act))


def run(
    plants: Sequence[Plant], act: Act, memories: Any, *, seconds: float, push: Push | None = None
) -> list[PlantRun]:
    """Resets plants of one layout and runs them in step; ends with zero controls, even if it is interrupted.

    Args:
        plants: one or several; they are guarded.
        act: result of `compiled`.
        memories: memories of the controller before the first sample, one for each plant along the leading axis.
        seconds: duration.
        push: applied to every running plant; by default none.

    Raises:
        InputError: a start is outside the limits, an answer has another shape, or plants without `kick` are pushed.
    """
    require_positive(seconds=seconds)
    if push is not None and any(plant.kick is None for plant in plants):
        raise InputError("the plant has no kick and cannot be pushed; leave the push out, or simulate the plant")
    layout, safe = plants[0].layout, [guarded(plant) for plant in plants]
    d, m = layout.actuation.shape
    samples, count = round(seconds * layout.rate), len(plants)
    y, u, times = np.zeros((samples, count, d)), np.zeros((samples, count, m)), np.zeros((samples, count))
    lengths, reasons = np.full(count, samples), [""] * count
    # Compile before a clock runs, or answers would be seconds late. The second call has the types of later memories.
    like = jnp.asarray(np.tile(np.asarray(layout.hanging, float), (count, 1)))
    act(act(memories, jnp.zeros(count), like)[0], jnp.zeros(count), like)
    for plant in safe:
        plant.reset()
    going = list(range(count))

    def measure(k: int, i: int) -> None:
        y[k, i] = safe[i].read()
        times[k, i] = safe[i].time()

    try:
        with _short_collections():
            for k in range(samples):
                if push is not None and k == round(push.seconds * layout.rate):
                    for i in going:
                        plants[i].kick(np.asarray(push.rates, float))  # type: ignore[misc]
                going = _each(going, k, lengths, reasons, lambda i: measure(k, i))  # noqa: B023
                if not going:
                    break
                memories, controls = act(memories, jnp.asarray(times[k] - times[0]), jnp.asarray(y[k]))
                u[k] = controls
                going = _each(going, k, lengths, reasons, lambda i: safe[i].act(u[k, i]))  # noqa: B023
    finally:  # also after an interrupt
        for i in going:
            plants[i].act(np.zeros(m))
    return [PlantRun(times[:n, i] - times[0, i], y[:n, i], u[:n, i], reasons[i]) for i, n in enumerate(lengths)]


@contextmanager
def _short_collections() -> Iterator[None]:
    """Excludes existing objects from garbage collection: going through the objects of JAX can take several samples."""
    alone = not gc.get_freeze_count()
    gc.freeze()
    try:
        yield
    finally:
        if alone:
            gc.unfreeze()


def _each(going: list[int], k: int, lengths: Any, reasons: list[str], do: Callable[[int], Any]) -> list[int]:
    """Calls `do` for the running plants; returns the plants that still run."""
    left = []
    for i in going:
        try:
            do(i)
            left.append(i)
        except Stopped as stopped:
            lengths[i], reasons[i] = k, str(stopped)
    return left


def start_of(controller: Controller, count: int) -> Any:
    """Returns the memories of `count` equal controllers."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(jnp.asarray(leaf), (count, *jnp.shape(leaf))), controller.start)


class Trials(NamedTuple):
    """Swing-ups from n starts."""

    seconds: Float[np.ndarray, " n"]
    """Time from which the plant stays up until the end, s; infinite if it does not."""
    stopped: tuple[str, ...]
    """Reasons why runs were stopped."""

    @property
    def up(self) -> Bool[np.ndarray, " n"]:
        """Mask of the starts that ended up."""
        return np.isfinite(self.seconds)


def distances(y: Float[np.ndarray, "N d"], layout: Layout) -> Float[np.ndarray, " N"]:
    """Returns the largest distance of an angle from the goal, rad."""
    angles = np.array([kind == "revolute" for kind in layout.joints])
    return np.abs(np.remainder(y - layout.goal + np.pi, 2 * np.pi) - np.pi)[:, angles].max(axis=1)


def judged_runs(runs: Sequence[PlantRun], layout: Layout, *, seconds: float) -> Trials:
    """Judges runs: every angle within `TOLERANCE` of the goal for the last `HELD` seconds, and never stopped."""

    def time_up(one: PlantRun) -> float:
        if one.stopped:
            return np.inf
        away = np.flatnonzero(~(distances(one.y, layout) <= TOLERANCE))
        last = 0.0 if not len(away) else (away[-1] + 1) / layout.rate
        return last if last <= seconds - HELD else np.inf

    return Trials(np.array([time_up(one) for one in runs]), tuple(one.stopped for one in runs if one.stopped))
