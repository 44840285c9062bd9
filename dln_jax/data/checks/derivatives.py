"""Checks qd and qdd against the derivatives of q: factor, sign and delay."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from dln_jax.data.checks.findings import Finding, Severity, on_joints
from dln_jax.data.encoders.smoothing import PART, Smoothed
from dln_jax.data.schema import Trajectories

RADIAN = 180 / np.pi
ALIKE = 0.9
"""Two signals with a higher correlation, after scaling and delay, count as equal."""
UNLIKE = 0.5
"""Two signals with a lower correlation count as unrelated."""
EXCHANGED = 0.3
"""qd and qdd count as exchanged if the error as the other rate is below this fraction of the error as their own."""
LATE = 0.5
"""Smallest delay reported, in samples."""
FARTHEST = 0.25
"""s: largest delay tested."""
TINY = np.finfo(float).tiny
RATE_REMEDY = "let --cutoff auto derive qd and qdd from q"


class Match(NamedTuple):
    """Least-squares match of two signals in every channel, measured(t) = factor * derived(t - delay)."""

    factor: Float[np.ndarray, " d"]
    delay: Float[np.ndarray, " d"]
    """Delay of the measured signal in samples."""
    correlation: Float[np.ndarray, " d"]
    gained: Float[np.ndarray, " d"]
    """Squared error without delay, divided by that at `delay`."""


def match(
    measured: Float[np.ndarray, "N d"], derived: Float[np.ndarray, "N d"], part: Int[np.ndarray, " N"], farthest: int
) -> Match:
    """Factor and delay that minimise the squared error between measured and derived signals."""
    shifts, columns = np.arange(-farthest, farthest + 1), np.arange(measured.shape[1])
    inside = away_from_ends(part, farthest)
    if len(inside) < 16:
        one, zero = np.ones(len(columns)), np.zeros(len(columns))
        return Match(factor=one, delay=zero, correlation=zero, gained=one)
    x = derived[inside]
    along = np.array([np.sum(measured[inside + shift] * x, axis=0) for shift in shifts])
    sizes = np.array([np.sum(measured[inside + shift] ** 2, axis=0) for shift in shifts])
    size = np.maximum(np.sum(x**2, axis=0), TINY)
    relative = (sizes - along**2 / size) / np.maximum(sizes, TINY)
    best = np.argmin(relative, axis=0)
    lowest, along = relative[best, columns], along[best, columns]
    offset = np.array([vertex(errors, place) for errors, place in zip(relative.T, best, strict=True)])
    return Match(
        factor=along / size,
        delay=shifts[best] + offset,
        correlation=np.sqrt(np.maximum(0.0, 1 - lowest)) * np.sign(along),
        gained=relative[farthest] / np.maximum(lowest, np.finfo(float).eps),
    )


def vertex(values: np.ndarray, lowest: int | np.integer) -> float:
    """Offset of the minimum of the parabola through the lowest value and its neighbours, in steps."""
    if not 0 < lowest < len(values) - 1:
        return 0.0
    before, here, after = values[lowest - 1 : lowest + 2]
    curvature = before - 2 * here + after
    return float(0.5 * (before - after) / curvature) if curvature > 0 else 0.0


def away_from_ends(part: Int[np.ndarray, " N"], farthest: int) -> Int[np.ndarray, " n"]:
    """Indices of samples with `farthest` neighbours of the same part on either side."""
    places = np.arange(farthest, len(part) - farthest)
    return places[(part[places - farthest] == part[places]) & (part[places + farthest] == part[places])]


def check_derivatives(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Checks that qd is the rate of q, and qdd the rate of qd, if the file has them; `even` is smooth(data, trim=0)."""
    findings = []
    moves = data.q.std(axis=0) > 0
    derived = {"qd": (even.data.qd, "dq/dt"), "qdd": (even.data.qdd, "d²q/dt²")}
    for key, other in (("qd", "qdd"), ("qdd", "qd")):
        if key in data.estimated:
            continue
        own, formula = derived[key]
        measured = at_times_of(data, even, getattr(data, key))
        if moves.any() and _closer(measured, own, derived[other][0], even.data.trajectory)[moves].all():
            observation = f"{key} is {derived[other][1]}, not {formula}"
            findings.append(Finding("error", f"{key}-exchanged", observation, f"exchange qd and qdd, or {RATE_REMEDY}"))
            continue
        farthest = max(2, min(round(FARTHEST * even.rate), 40, len(measured) // 8))
        matched = match(measured, own, even.data.trajectory, farthest)
        findings += _judged(key, formula, matched, even.rate, moves)
    return findings


def _closer(measured: np.ndarray, own: np.ndarray, other: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Whether every column, up to a factor, follows the other rate much better than its own."""
    inside = away_from_ends(part, 2)

    def left(reference: np.ndarray) -> np.ndarray:
        x, y = reference[inside], measured[inside]
        return 1 - np.sum(x * y, axis=0) ** 2 / np.maximum(np.sum(x**2, axis=0) * np.sum(y**2, axis=0), TINY)

    return (left(other) < 1 - ALIKE**2) & (left(other) < EXCHANGED * left(own))


def at_times_of(data: Trajectories, even: Smoothed, values: np.ndarray) -> np.ndarray:
    """Columns of a log at the times of its smoothed samples, by linear interpolation."""
    rows = np.empty((len(even.data.t), values.shape[1]))
    sources = {str(label): index for index, label in enumerate(data.label)}
    for index, label in enumerate(map(str, even.data.label)):
        source = sources.get(label, sources.get(label.rpartition(PART)[0]))
        here, there = even.data.trajectory == index, data.trajectory == source
        for column in range(values.shape[1]):
            rows[here, column] = np.interp(even.data.t[here], data.t[there], values[there, column])
    return rows


def _judged(key: str, formula: str, matched: Match, rate: float, moves: np.ndarray) -> list[Finding]:
    alike = (np.abs(matched.correlation) > ALIKE) & moves
    # Noise of the derived signal lowers the least-squares factor, noise of the measured one does not: the true factor
    # lies between the regressions of either signal on the other.
    least = np.abs(matched.factor)
    most = least / np.maximum(matched.correlation**2, TINY)

    def may_be(unit: float, tolerance: float) -> np.ndarray:
        return alike & (least < unit * tolerance) & (unit < most * tolerance)

    degrees, radians, milli = (may_be(unit, 1.05) for unit in (RADIAN, 1 / RADIAN, 1000.0))
    opposite = alike & (matched.factor < 0)
    other = alike & ~(degrees | radians | milli | opposite | may_be(1.0, 1.15))
    late = alike & (np.abs(matched.delay) > LATE) & (matched.gained > 1.5)
    worst = max(matched.delay[late], key=abs, default=0.0)
    delayed = f"up to {abs(worst) / rate * 1e3:.3g} ms {'late' if worst > 0 else 'early'}"
    ratios = ", ".join(f"{factor:.3g}" for factor in matched.factor[other])
    cases: tuple[tuple[Severity, str, np.ndarray, str, str], ...] = (
        ("error", "unit", degrees, f"is 57.3 times {formula}", f"convert {key} from degrees to radians"),
        ("error", "unit", radians, f"is {formula} / 57.3", "convert q from degrees to radians"),
        ("error", "unit", milli, f"is 1000 times {formula}", "give t in seconds"),
        ("error", "sign", opposite, f"has the opposite sign of {formula}", f"change the sign of {key} or q"),
        ("error", "unit", other, f"is {ratios} times {formula}", f"check units and gear ratios, or {RATE_REMEDY}"),
        ("error", "unlike", (np.abs(matched.correlation) < UNLIKE) & moves, f"does not follow {formula}",
         f"check the order of the columns, or {RATE_REMEDY}"),
        ("warning", "delay", late, f"is {delayed} relative to q", RATE_REMEDY),
    )  # fmt: skip
    return [
        finding
        for severity, kind, joints, observation, remedy in cases
        for finding in on_joints(severity, f"{key}-{kind}", joints, f"{key} of {{}} {observation}", remedy)
    ]
