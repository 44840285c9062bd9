"""Stamps of arrival are replaced by the source's times where q and qd tell them, and only there."""

import numpy as np
import pytest

from dln_jax.data.encoders.clock import source_clock
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import from_arrays

PERIOD = 1e-3


def motion(t, d=3):
    """q and qd of a smooth motion at the times t, which rests at first."""
    random = np.random.default_rng(0)
    frequencies, phases = random.uniform(0.3, 2.0, size=(2, 5, d))
    angles = 2 * np.pi * np.multiply.outer(t, frequencies) + phases
    start, rate = np.clip(t - 0.3, 0, 1)[:, None] ** 2, 2 * np.clip(t - 0.3, 0, 1)[:, None] * (t < 1.3)[:, None]
    q, qd = np.sin(angles).sum(axis=1), (2 * np.pi * frequencies * np.cos(angles)).sum(axis=1)
    return start * q, start * qd + rate * q


def log(t, stamps, *, noise=1e-6, **changes):
    """A log of the motion at the times t, with other stamps."""
    random = np.random.default_rng(0)
    q, qd = motion(t)
    arrays = {"q": q + noise * random.normal(size=q.shape), "qd": qd + 2e-3 * random.normal(size=q.shape)}
    return from_arrays({**arrays, "tau": q, "t": stamps, "trajectory": np.zeros(len(t), int), **changes})


def arrived(t, seed=0, late=3e-4):
    """Stamps of rows that arrive late by exponentially distributed times, in order."""
    late_by = np.random.default_rng(seed).exponential(late, size=len(t))
    return np.maximum.accumulate(t + late_by) + 1e-9 * np.arange(len(t))


def moving(t):
    """Rows at which the motion is fast enough to tell the time."""
    qd = motion(t)[1]
    return np.mean(qd**2, axis=1) > 0.5 * np.mean(qd**2)


def lost(count, seed=0):
    """Times of a regular source, of which one row in twenty is lost."""
    return PERIOD * np.flatnonzero(np.random.default_rng(seed).random(count) >= 0.05)


def test_the_source_s_times_are_found_up_to_a_constant():
    """Also if the clock of the stamps runs at another rate."""
    for seed, rate in ((0, 1.0), (1, 1.001)):
        t = lost(6000, seed)
        clock = source_clock(log(t, rate * arrived(t, seed)))
        assert clock is not None and clock.period == pytest.approx(rate * PERIOD, rel=1e-3)
        error, stamped = clock.t - rate * t, arrived(t, seed) - t
        assert np.ptp(error[moving(t)]) < 0.1 * PERIOD < 0.05 * np.ptp(stamped[moving(t)])


def test_trajectories_keep_their_own_starts():
    t = lost(3000)
    stamps = np.concatenate([arrived(t, 1), 5 + arrived(t, 2)])
    data = log(np.tile(t, 2), stamps, trajectory=np.repeat([0, 1], len(t)))
    clock = source_clock(data)
    assert clock is not None
    for found, start in zip(np.split(clock.t, 2), (0.0, 5.0), strict=True):
        assert np.ptp((found - t - start)[moving(t)]) < 0.1 * PERIOD


def test_stamps_stay_where_motions_do_not_tell_otherwise():
    t = lost(4000)
    still = {"q": np.ones((len(t), 3)), "qd": np.zeros((len(t), 3))}
    for why, data in (
        ("regular stamps", log(t, t)),
        ("rows measured when they are stamped", log(arrived(t), arrived(t))),
        ("rates in degrees", log(t, arrived(t), qd=np.rad2deg(motion(t)[1]))),
        ("encoders that are too noisy to tell", log(t, arrived(t), noise=1e-3)),
        ("rest", log(t, arrived(t), **still)),
        ("stamps that are too late to trust", log(t, arrived(t, late=0.05))),
    ):
        assert source_clock(data) is None, why
    assert smooth(log(t, arrived(t))._replace(estimated=("qd", "qdd"))).clock is None, "no rates"


def test_accelerations_from_stamps_of_arrival_are_as_good_as_from_the_source_s_times():
    t, h = lost(6000), 1e-4
    late = log(t, arrived(t))
    errors = []
    for data, offset in ((log(t, t), 0.0), (late, 3e-4), (late._replace(estimated=("qd", "qdd")), 3e-4)):
        smoothed = smooth(data, 15.0).data
        times = smoothed.t - offset
        truth = (motion(times + h)[1] - motion(times - h)[1]) / (2 * h)
        errors.append(np.sqrt(np.mean((smoothed.qdd - truth)[times > 0.6] ** 2)))
    exact, stamped, blind = errors
    assert stamped < 1.2 * exact + 0.05 * blind and blind > 3 * exact
