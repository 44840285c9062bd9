"""Checks qd and qdd against the derivatives of q: factor, sign and delay."""

from typing import NamedTuple

import numpy as np

from dln_jax.data.checks.delays import away_from_ends, vertex
from dln_jax.data.checks.findings import Finding, named
from dln_jax.data.encoders.smoothing import Smoothed
from dln_jax.data.schema import Trajectories

RADIAN = 180 / np.pi
ALIKE = 0.9
"""Correlation, after scaling and delay, above which two signals count as equal."""
UNLIKE = 0.5
"""Correlation below which two signals count as unrelated."""
EXCHANGED = 0.3
"""qd and qdd count as exchanged if the error as the other rate is below this fraction of the error as their own."""
LATE = 0.5
"""Smallest delay reported, in samples."""
FARTHEST = 0.25
"""s: largest delay tested."""
RATE_REMEDY = "leave qd and qdd out of the file, and let --cutoff auto derive them from q"


class Match(NamedTuple):
    """Least-squares match of two signals, measured(t) = factor * derived(t - delay)."""

    factor: float
    delay: float
    """Delay of the measured signal in samples."""
    correlation: float
    gained: float
    """Squared error at no delay over that at `delay`."""


def match(measured: np.ndarray, derived: np.ndarray, part: np.ndarray, farthest: int) -> Match:
    """Factor and delay that minimise the squared error between a measured and a derived signal."""
    shifts = np.arange(-farthest, farthest + 1)
    inside = away_from_ends(part, farthest)
    if len(inside) < 16 or not derived[inside].any():
        return Match(1.0, 0.0, 0.0, 1.0)
    x = derived[inside]
    products = np.array([[measured[inside + s] @ x, measured[inside + s] @ measured[inside + s]] for s in shifts])
    errors = products[:, 1] - products[:, 0] ** 2 / (x @ x)
    relative = errors / np.maximum(products[:, 1], np.finfo(float).tiny)
    best = int(np.argmin(relative))
    place = float(shifts[best]) + vertex(relative, best)
    correlation = np.sqrt(max(0.0, 1 - relative[best])) * np.sign(products[best, 0])
    now = relative[farthest]
    least = max(float(relative[best]), float(np.finfo(float).eps))
    return Match(float(products[best, 0] / (x @ x)), place, float(correlation), float(now / least))


def check_derivatives(data: Trajectories, even: Smoothed) -> list[Finding]:
    """Checks that qd is the rate of q, and qdd that of qd, if the file has them; `even` is smooth(data, trim=0)."""
    found = []
    for key, derived, of in (("qd", even.data.qd, "dq/dt"), ("qdd", even.data.qdd, "d²q/dt²")):
        if key in data.estimated:
            continue
        measured = at_times_of(data, even, getattr(data, key))
        farthest = max(2, min(round(FARTHEST * even.rate), 40, len(measured) // 8))
        matches = [
            match(measured[:, joint], derived[:, joint], even.data.trajectory, farthest)
            for joint in range(data.degrees_of_freedom)
        ]
        moves = data.q.std(axis=0) > 0
        other = "qdd" if key == "qd" else "qd"
        exchanged = _closer(measured, derived, getattr(even.data, other), even.data.trajectory) & moves
        if exchanged[moves].all() and moves.any():
            said = f"{key} is {'d²q/dt²' if key == 'qd' else 'dq/dt'}, not {of}"
            found.append(Finding("error", f"{key}-exchanged", said, "exchange qd and qdd, or " + RATE_REMEDY))
            continue
        found += _judged(key, of, matches, even.rate, moves)
    return found


def _closer(measured: np.ndarray, own: np.ndarray, other: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Whether every column, up to a factor, follows the other rate much better than its own."""
    inside = away_from_ends(part, 2)

    def left(reference: np.ndarray) -> np.ndarray:
        x, y = reference[inside], measured[inside]
        tiny = np.finfo(float).tiny
        return 1 - np.sum(x * y, axis=0) ** 2 / np.maximum(np.sum(x**2, axis=0) * np.sum(y**2, axis=0), tiny)

    return (left(other) < 1 - ALIKE**2) & (left(other) < EXCHANGED * left(own))


def at_times_of(data: Trajectories, even: Smoothed, values: np.ndarray) -> np.ndarray:
    """Columns of a log at the times of its smoothed samples, by linear interpolation."""
    rows = np.empty((len(even.data.t), values.shape[1]))
    names = [str(label).rpartition("/")[0] or str(label) for label in even.data.label]
    known = [str(label) for label in data.label]
    for index, label in enumerate(map(str, even.data.label)):
        source = known.index(label) if label in known else known.index(names[index])
        here, there = even.data.trajectory == index, data.trajectory == source
        for column in range(values.shape[1]):
            rows[here, column] = np.interp(even.data.t[here], data.t[there], values[there, column])
    return rows


def _judged(key: str, of: str, matches: list[Match], rate: float, moves: np.ndarray) -> list[Finding]:
    found, factors = [], np.array([each.factor for each in matches])
    alike = np.array([abs(each.correlation) > ALIKE for each in matches]) & moves
    unlike = np.array([abs(each.correlation) < UNLIKE for each in matches]) & moves

    def where(chosen: np.ndarray) -> tuple[str, tuple[int, ...]]:
        joints = np.flatnonzero(chosen)
        return named(joints), tuple(map(int, joints))

    def add(severity, check: str, chosen: np.ndarray, said: str, remedy: str) -> None:
        if chosen.any():
            names, joints = where(chosen)
            found.append(Finding(severity, check, f"{key} of {names} {said}", remedy, joints))

    degrees = alike & (np.abs(np.abs(factors) / RADIAN - 1) < 0.05)
    radians = alike & (np.abs(np.abs(factors) * RADIAN - 1) < 0.05)
    milli = alike & (np.abs(np.abs(factors) / 1000 - 1) < 0.05)
    add("error", f"{key}-unit", degrees, f"is 57.3 times {of}", f"convert {key} from degrees to radians")
    add("error", f"{key}-unit", radians, f"is {of} / 57.3", "convert q from degrees to radians")
    add("error", f"{key}-unit", milli, f"is 1000 times {of}", "give t in seconds")
    opposite = alike & (factors < 0)
    add("error", f"{key}-sign", opposite, f"has the opposite sign of {of}", f"turn {key} or q round")
    other = alike & ~(degrees | radians | milli | opposite) & (np.abs(np.log(np.abs(factors) + 1e-300)) > np.log(1.15))
    if other.any():
        ratios = ", ".join(f"{factor:.3g}" for factor in factors[other])
        add("error", f"{key}-unit", other, f"is {ratios} times {of}", "see units and gear ratios, or " + RATE_REMEDY)
    add("error", f"{key}-unlike", unlike, f"does not follow {of}", "see the order of the columns, or " + RATE_REMEDY)
    late = alike & np.array([abs(each.delay) > LATE and each.gained > 1.5 for each in matches])
    if late.any():
        worst = max((each.delay for each, is_late in zip(matches, late, strict=True) if is_late), key=abs)
        word = "late" if worst > 0 else "early"
        add("warning", f"{key}-delay", late, f"is up to {abs(worst) / rate * 1e3:.3g} ms {word} after q", RATE_REMEDY)
    return found
