"""Prepares measured motions for a Hamiltonian task: training and test parts, rates, and noise levels.

Motions with noisy states are fitted through an integrator, weighted by that noise. If states and rates are free of
noise, a fit of the rates is sufficient.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.arrays import spread
from dln_jax.data.bodies import find_bodies
from dln_jax.data.encoders.smoothing import FEWEST, smooth_locally
from dln_jax.data.repeated_motions import motion_numbers
from dln_jax.data.schema import Trajectories, column, time_derivative
from dln_jax.data.splits import (
    by_motion,
    label_indices,
    require_no_copies,
    segments,
    select,
    select_samples,
    stated_test,
    with_joints,
)
from dln_jax.learning.shooting import MeasuredWindows, Noise, Weights
from dln_jax.metrics.motions import cut_recordings, grid_places
from dln_jax.metrics.phase_space import Motions
from dln_jax.types import InputError, Needs

REAL, MEASURED = "real-pendulum", "measured"
TEST_SHARE = 0.2
"""Fraction of a single measured trajectory, at its end, used for the test, as published."""
HORIZON_WINDOWS = 20
"""Largest number of windows predicted for a measured motion; a longer gap ends a recording."""
LEAST_NOISE = 1e-6
"""Measurements with noise below this fraction of their spread count as exact."""
FREE_OF_NOISE = 1e-3
"""Below this ratio of the states' noise to their spread the bias of a fit of rates, its square, is negligible."""
LEAST_RATE_NOISE = 0.01
"""Lower limit of the noise of measured rates, relative to their spread, since no model has them exactly."""
ANCHOR = 30.0
"""Noise of estimated momenta, in units of their spread: without any weight, a model could choose its own momentum."""
SURVEYED = 1_500
"""Approximate number of samples used to estimate noise; this gives its standard deviation to 2 %."""
WINDOW = {REAL: 30, MEASURED: 30}
"""Samples per window of measurements; trajectories shorter than two windows are used as one."""


class Stated(NamedTuple):
    """Facts about measurements that the user states in addition to their file."""

    needs: Needs | None = None
    """`Needs` of the plant (default: the file's, else bodies if forces balance, else revolute joints with friction)."""
    test: str | None = None
    """Labels of the test trajectories, separated by commas, or an npz file with test trajectories."""
    noise: tuple[float, ...] | None = None
    """Standard deviation of q, one for all or one each; or, if the file has p, of q and then p (default: estimated)."""
    file: Mapping[str, Any] = MappingProxyType({})
    """Keywords of `data.schema.load`."""


class Trust(NamedTuple):
    """How far the states and rates of a phase space can be trusted."""

    weights: Weights
    free_of_noise: bool
    """Whether rates are measured and states have so little noise that fitting the rates is sufficient."""
    noise: np.ndarray
    """Standard deviations of the noise of q and p that was stated or measured [2 d]; 0 where it is unknown."""


NOTHING = Stated()


def needs_of(data: Trajectories, file: str, stated: Needs | None) -> Needs:
    """`Needs` of a plant without applied forces; `InputError` if forces act or the number of joints differs."""
    d = data.degrees_of_freedom
    if "tau" not in data.estimated and np.any(data.tau):
        raise InputError(f"{file} has applied forces tau; a phase field knows none: train it with train_hnn --data")
    needs = stated or data.needs or assumed_needs(data)
    if needs.degrees_of_freedom != d:
        raise InputError(f"the needs have {needs.degrees_of_freedom} joints, but {file} has {d}; make them agree")
    return needs


def assumed_needs(data: Trajectories) -> Needs:
    """Prismatic coordinates if the measured forces balance as between bodies, else revolute joints with friction."""
    d = data.degrees_of_freedom
    if find_bodies(forces_of(data)) is not None:
        return Needs(joints=("prismatic",) * d)
    return Needs(joints=("revolute",) * d, friction=True)


def forces_of(data: Trajectories) -> np.ndarray:
    """pd if known, else accelerations: forces up to the masses."""
    return data.qdd if data.pd is None else data.pd


def parted(name: str, data: Trajectories, file: str, test: str | None) -> tuple[Trajectories, Trajectories]:
    """Training and test trajectories; `InputError` if one is missing or too short, or the test copies training data."""
    present = np.unique(data.trajectory)
    if test is not None and test.endswith(".npz"):
        other = schema.load(test)
        if other.degrees_of_freedom != data.degrees_of_freedom:
            raise InputError(f"{test} has {other.degrees_of_freedom} coordinates, {file} {data.degrees_of_freedom}")
        if data.joint_names is not None and other.joint_names is not None:
            other = with_joints(other, data.joint_names.tolist())
        return data._replace(remarks=(*data.remarks, *(f"{test}: {line}" for line in other.remarks))), other
    if test is None and len(present) == 1:
        count = len(data.t) - round(TEST_SHARE * len(data.t))
        if min(count, len(data.t) - count) < WINDOW[name]:
            raise InputError(f"{file} has {len(data.t)} samples; expected some hundred, a fifth of them for the test")
        return select_samples(data, slice(0, count)), select_samples(data, slice(count, None))
    data, labels = stated_test(data, test)
    present = np.unique(data.trajectory)
    if labels is None:
        motion = motion_numbers(data.q, data.trajectory) if test is None else None
        chosen = by_motion(present, motion, slice(5, None, 6), least=2)
    else:
        chosen = label_indices(data, labels)
    rest = np.setdiff1d(present, chosen)
    if not len(rest):
        raise InputError(f"all trajectories of {file} are for the test; leave some to learn from")
    fitted, held = select(data, rest), select(data, chosen)
    require_no_copies(fitted, held)
    return fitted, held


def with_rates(data: Trajectories, noise: tuple[float, ...] | None) -> tuple[Trajectories, Noise]:
    """Adds velocities and accelerations from local polynomials if they were not measured, and estimates the noise.
    Raises `InputError` for noise of another number of coordinates, or segments that are too short."""
    d = data.degrees_of_freedom
    if noise is not None and len(noise) not in (1, d):
        raise InputError(f"noise has {len(noise)} numbers; expected one, or one for each of {d} coordinates")
    smooth = smooth_locally(data)
    of_q = _at_least(smooth.noise if noise is None else np.broadcast_to(noise, d), data.q)
    if "qd" not in data.estimated:
        return data, Noise(of_q, _at_least(smooth_locally(data._replace(q=data.qd)).noise, data.qd))
    kept = select_samples(data, smooth.rows)
    return kept._replace(qd=smooth.data.qd, qdd=smooth.data.qdd), Noise(of_q)


def with_momenta(data: Trajectories) -> Trajectories:
    """Adds p, by default qd, and pd, by default the rate of p; `estimated` names those that are not measured."""
    if data.p is None:
        own = tuple(key for key, source in (("p", "qd"), ("pd", "qdd")) if source in data.estimated)
        return data._replace(p=data.qd, pd=data.qdd, estimated=(*data.estimated, *own))
    if data.pd is None:
        pd = time_derivative(data.t, data.p, data.trajectory, name="pd")
        return data._replace(pd=pd, estimated=(*data.estimated, "pd"))
    return data


def trust_of(data: Trajectories, noise: tuple[float, ...] | None) -> Trust | None:
    """Weights of data with momenta from stated or estimated noise; `None` if all segments are too short.
    Raises `InputError` for noise of another number of coordinates, or noise stated for segments that are too short."""
    d, own = data.degrees_of_freedom, "p" not in data.estimated
    if noise is not None and len(noise) not in ((1, d, 2 * d) if own else (1, d)):
        more = f", or {2 * d} of q and then p" if own else ""
        raise InputError(f"noise has {len(noise)} numbers; expected one, or one for each of {d} coordinates{more}")
    parts = segments(data.t, data.trajectory)
    if max(map(len, parts)) < FEWEST:
        if noise is None:
            return None
        raise InputError(f"--noise is for motions, but no segment without a gap has {FEWEST} samples; leave it out")
    order = np.random.default_rng(0).permutation(len(parts))
    count = int(np.searchsorted(np.cumsum([len(parts[index]) for index in order]), SURVEYED)) + 1
    surveyed = select_samples(data, np.concatenate([parts[index] for index in sorted(order[:count])]))
    sizes = {key: spread(key, column(data, key)) for key in ("q", "p", "qd", "pd")}
    sizes = {key: np.where(size > 0, size, 1.0) for key, size in sizes.items()}

    known = {key: np.zeros(d) for key in sizes}

    def of(key: str, least: float) -> np.ndarray:
        smooth = smooth_locally(surveyed._replace(q=column(surveyed, key)))
        known[key] = np.where(smooth.resolved, smooth.noise, 0.0)
        return np.maximum(smooth.noise, least * sizes[key])

    if noise is None:
        of_q = of("q", FREE_OF_NOISE)
    else:
        of_q = known["q"] = np.broadcast_to(noise[:d], d)
    if noise is not None and len(noise) == 2 * d:
        of_p = known["p"] = np.asarray(noise[d:])
    else:
        of_p = ANCHOR * sizes["p"] if "p" in data.estimated else of("p", FREE_OF_NOISE)
    rates = [sizes[key] * np.inf if key in data.estimated else of(key, LEAST_RATE_NOISE) for key in ("qd", "pd")]
    rate = np.concatenate(rates)
    weights = Weights(
        tuple(np.concatenate([of_q, of_p]).tolist()), tuple(rate.tolist()) if np.isfinite(rate).any() else None
    )
    quiet = np.all(of_q <= FREE_OF_NOISE * sizes["q"]) and np.all(of_p <= FREE_OF_NOISE * sizes["p"])
    return Trust(weights, bool(quiet and np.isfinite(rate).all()), np.concatenate([known["q"], known["p"]]))


def _at_least(noise: np.ndarray, values: np.ndarray) -> tuple[float, ...]:
    """The noise, limited below by `LEAST_NOISE` times the spread."""
    size = spread("q and qd", values)
    return tuple(np.maximum(noise, LEAST_NOISE * np.where(size > 0, size, 1.0)).tolist())


def to_predict(test: Trajectories) -> MeasuredWindows | None:
    """Recordings cut to at most `HORIZON_WINDOWS` windows, across gaps; `None` if no segment exceeds one."""
    parts = segments(test.t, test.trajectory)
    if max(map(len, parts)) <= WINDOW[MEASURED]:
        return None
    longest = max(int(grid_places(test.t[test.trajectory == index])[-1]) + 1 for index in np.unique(test.trajectory))
    return cut_recordings(test, min(longest, HORIZON_WINDOWS * WINDOW[MEASURED]), fitted=WINDOW[MEASURED])


def gap_count(test: Trajectories) -> int:
    """Number of gaps within trajectories."""
    return len(segments(test.t, test.trajectory)) - len(np.unique(test.trajectory))


def motion_of(test: Trajectories) -> Motions:
    """One trajectory as the motion to predict, up to a gap longer than any prediction."""
    longest = np.diff(grid_places(test.t)) > HORIZON_WINDOWS * WINDOW[MEASURED]
    length = int(np.argmax(longest)) + 1 if longest.any() else len(test.t)
    t = test.t[:length] - test.t[0]
    return Motions(t, test.q[None, :length], column(test, "p")[None, :length])


def pieces(data: Trajectories, length: int) -> Trajectories:
    """Segments cut to the length of two windows, as trajectories of their own, so that some can be held out."""
    parts = [
        rows[at : at + 2 * length]
        for rows in segments(data.t, data.trajectory)
        for at in range(0, len(rows), 2 * length)
    ]
    index = np.arange(len(parts))
    return data._replace(trajectory=np.repeat(index, [len(part) for part in parts]), label=index.astype(str))
