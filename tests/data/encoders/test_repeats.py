"""Logs that repeat rows: they are found, told apart from rest and turning points, and resampled over."""

import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.encoders import find_repeats, smooth, without_repeats

JOINTS = 4


def motion(t, joint):
    """q and qdd of a joint: a few slow sines."""
    random = np.random.default_rng(joint)
    w = 2 * np.pi * np.array([0.2, 0.5, 1.1, 1.7])[:, None]
    a, b = random.uniform(-1, 1, (2, 4, 1)) / (1 + w)
    waves = a * np.sin(w * t) + b * np.cos(w * t)
    return waves.sum(axis=0), (-(w**2) * waves).sum(axis=0)


def log(*, rate=125.0, noise=1e-4, seconds=20.0):
    """Arrays of one trajectory, and its true accelerations."""
    t, random = np.arange(round(seconds * rate)) / rate, np.random.default_rng(1)
    q, qdd = (np.stack(each, 1) for each in zip(*(motion(t, joint) for joint in range(JOINTS)), strict=True))
    arrays = {
        "t": t,
        "q": q + noise * random.normal(size=q.shape),
        "tau": qdd + 0.1 * random.normal(size=q.shape),
        "trajectory": np.zeros(len(t), int),
    }
    return arrays, qdd


def repeated_every(arrays, step, keys=("q", "tau")):
    """Every so manyth row holds the values of the one before."""
    rows = np.arange(step, len(arrays["t"]) - 5, step)
    changed = {key: arrays[key].copy() for key in keys}
    for values in changed.values():
        values[rows] = values[rows - 1]
    return {**arrays, **changed}, rows


def error(smoothed, qdd, rate):
    inside = np.round(smoothed.data.t * rate).astype(int)
    return np.sqrt(np.mean((smoothed.data.qdd - qdd[inside]) ** 2))


@pytest.mark.parametrize("rate", [30.0, 125.0])
@pytest.mark.parametrize("noise", [1e-5, 1e-3])
@pytest.mark.parametrize("keys", [("q", "tau"), ("q",)])
def test_one_repeated_row_in_a_hundred_does_not_change_the_cutoff(rate, noise, keys):
    arrays, qdd = log(rate=rate, noise=noise, seconds=30.0)
    repeated, rows = repeated_every(arrays, 101, keys)
    clean, smoothed = smooth(schema.from_arrays(arrays), trim=1.0), smooth(schema.from_arrays(repeated), trim=1.0)
    assert np.array_equal(np.flatnonzero(smoothed.repeats.q), rows)
    assert smoothed.cutoff == pytest.approx(clean.cutoff, rel=0.05)
    assert error(smoothed, qdd, rate) < 1.3 * error(clean, qdd, rate)


def test_inserted_rows_give_their_time_back():
    arrays, qdd = log(rate=30.0, seconds=24.0)
    place = np.arange(50, 690, 49)
    order = np.sort(np.r_[np.arange(len(qdd)), place])
    longer = {key: arrays[key][order] for key in ("q", "tau", "trajectory")}
    data, repeats = without_repeats(schema.from_arrays({**longer, "t": np.arange(len(order)) / 30.0}))
    assert repeats.inserted and repeats.rows.sum() == len(place)
    assert np.array_equal(data.q, arrays["q"])
    steps = np.diff(data.t)
    assert steps == pytest.approx(np.full(len(steps), steps[0])) and steps[0] > 1 / 30.0
    smoothed = smooth(schema.from_arrays({**longer, "t": np.arange(len(order)) / 30.0}))
    assert smoothed.cutoff == pytest.approx(smooth(schema.from_arrays(arrays)).cutoff, rel=0.05)


def test_rest_and_turning_points_are_no_repeats():
    t = np.arange(400) / 100.0
    symmetric = np.cos(2 * np.pi * (t - 0.005))[:, None]  # equal on both sides of every turning point
    trajectory = np.zeros(400, int)
    assert not find_repeats(symmetric, -symmetric, trajectory).q.any()
    resting = np.where(t < 2.0, 1.0, 1.0 - 0.5 * (t - 2.0) ** 2)[:, None]
    assert not find_repeats(resting, resting, trajectory).q.any()
    stepped = np.round(np.sin(t)[:, None] / 0.01) * 0.01  # an encoder so coarse that it often reads the same twice
    assert not find_repeats(stepped, stepped, trajectory).q.any()


def test_noise_is_filtered_in_spite_of_jumps():
    arrays, _ = log(noise=1e-4)
    jumping = arrays["q"].copy()
    jumping[50::97, 0] += 0.05
    smoothed = smooth(schema.from_arrays({**arrays, "q": jumping}))
    clean = smooth(schema.from_arrays(arrays))
    assert np.isfinite(smoothed.cutoff)
    assert smoothed.noise_q == pytest.approx(clean.noise_q, rel=0.1)
