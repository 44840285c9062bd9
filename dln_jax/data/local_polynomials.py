"""Velocities, accelerations and noise of measured coordinates by local polynomials.

A polynomial in time is fitted by least squares to the neighbours of every sample, at any spacing (Savitzky and Golay
1964). The number of neighbours is chosen per coordinate by leave-one-out error, e_i / (1 - H_ii) (Allen 1974): few for
a strongly curved motion, many for a noisy one. This assumes independent noise; otherwise state `points`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from dln_jax.data.arrays import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import GAP, segments
from dln_jax.types import InputError

DEGREE = 4
"""Degree of the polynomials: high enough for the acceleration itself to have slope and curvature."""
GROWTH = 1.3
"""Ratio of successive numbers of neighbours tried."""
MOST_POINTS = 401


class Smoothed(NamedTuple):
    """Trajectories with q, qd and qdd from local polynomials; all else is unchanged."""

    data: Trajectories
    noise: Float[np.ndarray, " d"]
    """Standard deviation of the noise of q, rad or m."""
    points: tuple[int, ...]
    """Neighbours used for each coordinate, the sample itself included."""
    rows: np.ndarray
    """Rows of the samples kept."""


class _Fits(NamedTuple):
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    left_out: np.ndarray
    """Leave-one-out errors."""
    variance: np.ndarray
    """Noise variance estimated from the residual of every sample."""


def smooth_locally(
    data: Trajectories, *, points: int | None = None, degree: int = DEGREE, gap: float = GAP
) -> Smoothed:
    """Smooths coordinates and estimates their rates; segments (without a gap) that have too few samples are left out.

    Args:
        data: trajectories; only q and t enter the fit.
        points: neighbours of every sample, itself included (default: chosen per coordinate).
        degree: degree of the polynomials, at least 2.
        gap: as for `data.segments.segments`.

    Raises:
        InputError: the degree is below 2, `points` is below degree + 2, or no segment is long enough.
    """
    spread("q", data.q)
    least = degree + 2
    if degree < 2:
        raise InputError(f"degree is {degree}; expected at least 2, for an acceleration")
    if points is not None and points < least:
        raise InputError(f"points is {points}; expected at least {least} for polynomials of degree {degree}")
    parts = [each for each in segments(data.t, data.trajectory, gap=gap) if len(each) >= max(least, points or 0)]
    if not parts:
        raise InputError(f"no segment without a gap has {max(least, points or 0)} samples; record longer motions")
    shortest = min(map(len, parts))
    kept = np.concatenate(parts)
    chosen, columns, noise = [], [], []
    for q in data.q.T:
        sizes = [points] if points else _sizes(least, min(MOST_POINTS, shortest))
        found = [_over(parts, data.t, q, size, degree) for size in sizes]
        best = int(np.argmin([np.mean(each.left_out**2) for each in found]))
        chosen.append(sizes[best])
        columns.append(found[best])
        noise.append(np.sqrt(np.mean(found[best].variance)))
    smooth = {key: np.stack([getattr(each, key) for each in columns], axis=1) for key in ("q", "qd", "qdd")}
    optional = ("tau", "p", "pd", "tau_inertial", "tau_coriolis", "tau_gravity", "t", "trajectory")
    others = {key: array[kept] for key in optional if (array := getattr(data, key)) is not None}
    return Smoothed(data._replace(**others, **smooth), np.array(noise), tuple(chosen), kept)


def _sizes(least: int, most: int) -> list[int]:
    # Odd numbers, which centre the window on its sample.
    sizes = [least + (least % 2 == 0)]
    while (longer := 2 * int(np.ceil((GROWTH * sizes[-1] - 1) / 2)) + 1) <= most:
        sizes.append(longer)
    return [min(size, most) for size in sizes]


def _over(parts: list[np.ndarray], t: np.ndarray, q: np.ndarray, size: int, degree: int) -> _Fits:
    fits = [_segment(t[part], q[part], size, degree) for part in parts]
    return _Fits(*(np.concatenate(arrays) for arrays in zip(*fits, strict=True)))


def _segment(t: np.ndarray, q: np.ndarray, size: int, degree: int) -> _Fits:
    first = np.clip(np.arange(len(t)) - size // 2, 0, len(t) - size)
    around = first[:, None] + np.arange(size)
    unit = 0.5 * (t[-1] - t[0]) * size / len(t)
    powers = ((t[around] - t[:, None]) / unit)[..., None] ** np.arange(degree + 1)
    # The normal equations are safe here: the matrices are small and times are scaled.
    inverse = np.linalg.solve(powers.transpose(0, 2, 1) @ powers, powers.transpose(0, 2, 1))
    value, slope, bend = (inverse[:, order] for order in range(3))
    smooth = np.einsum("ns,ns->n", value, q[around])
    own = value[np.arange(len(t)), np.arange(len(t)) - first]
    residual = q - smooth
    return _Fits(
        smooth,
        np.einsum("ns,ns->n", slope, q[around]) / unit,
        2 * np.einsum("ns,ns->n", bend, q[around]) / unit**2,
        residual / (1 - own),
        residual**2 / (1 - own),
    )
