"""Stops a plant that leaves its limits of position, rate or control, or whose answers are late or not finite."""

import math
from collections import deque
from typing import Any

import numpy as np

from dln_jax.control.plants.plant import Plant
from dln_jax.types import InputError

NEAR = 1.0
"""Largest angle of a passive joint from hanging at a start, rad: a pole that still stands does not hang."""
SPAN = 5
"""Samples over which a rate is measured, so that an encoder step does not look like a high rate."""
ROUNDING = 1e-9


class Stopped(RuntimeError):
    """The plant was stopped, with zero controls; the message says why. It acts again after a reset."""


def guarded(plant: Plant) -> Plant:
    """Wraps a plant so that it stops, with zero controls and `Stopped`, once it leaves its limits or answers wrongly.

    Measured angles may be wrapped; those of the guarded plant are continuous. Its time is that of the last answer. The
    reset raises `InputError` for a start outside the limits or far from hanging, or an answer of another shape.
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
            raise InputError(f"{why}: the start is outside the limits; reset the plant to a posture within")
        away = np.where(swinging, np.abs(q - layout.hanging), 0.0)
        if away.max() > NEAR:
            raise InputError(
                f"'{layout.names[int(np.argmax(away))]}' starts {away.max():.3g} rad from hanging; expected at most "
                f"{NEAR:g}: let the reset return when the plant has come to rest there, or check the layout's hanging"
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
