"""Logs of encoders: noise, filter, derivatives and cut-off against closed forms; gaps, jitter and repeated rows."""

import numpy as np
import pytest
from calls import one_line
from motions import sums_of_sines
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.data.encoders.filters import derivatives, gain, low_pass
from dln_jax.data.encoders.sampling import (
    find_repeats,
    held_at_equal_steps,
    noise_of,
    step_of,
    torque_noise,
    without_repeats,
)  # fmt: skip
from dln_jax.data.encoders.smoothing import labels_of_parts, smooth
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import every

RATE, SECONDS = 125.0, 10.0
NOISE_Q, NOISE_TAU = 1e-4, 0.2


def motion(t):
    """q, qd and qdd of two joints: a few slow sines."""
    random, rates = np.random.default_rng(0), 2 * np.pi * np.array([0.2, 0.5, 1.1, 1.7])
    sizes = random.uniform(0.3, 1.0, (2, 4)) / (1 + rates)
    return sums_of_sines(t, sizes, rates, random.uniform(0, 2 * np.pi, (2, 4)))


def log(*, noise=NOISE_Q, rate=RATE, trajectories=3, t=None, seed=0):
    """Arrays of a log and the true rates; its trajectories follow each other in one long motion."""
    random = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * rate)) / rate if t is None else t
    trajectory = np.repeat(np.arange(trajectories), len(t))
    t = np.tile(t, trajectories)
    q, qd, qdd = motion(t + SECONDS * trajectory)
    arrays = {
        "t": t,
        "q": q + noise * random.normal(size=q.shape),
        "tau": qdd + 0.3 * qd + NOISE_TAU * random.normal(size=q.shape),
        "trajectory": trajectory,
        "label": np.array([f"run{k}" for k in range(trajectories)]),
    }
    return arrays, qd, qdd


def one_channel(t, q, tau=0.0):
    """A log of one joint in one trajectory."""
    columns = {"q": q[:, None], "tau": tau + 0 * q[:, None]}
    return from_arrays({"t": t, **columns, "trajectory": np.zeros(len(t), int)})


def rms(x):
    return np.sqrt(np.mean(np.square(x)))


def within(data, ends):
    """Samples away from the ends of their trajectories."""
    return np.concatenate([np.flatnonzero(data.trajectory == k)[ends:-ends] for k in np.unique(data.trajectory)])


def assert_nearly_best(data, key, truth, trim, cutoffs):
    """Asserts that the rates of the chosen cut-off are as good as the best ones, but for a quarter."""
    inside = within(data, round(trim / data.t[1]))

    def error(cutoff):
        return rms(getattr(smooth(data, cutoff, trim=trim).data, key) - truth[inside])

    assert error(None) < 1.25 * min(map(error, cutoffs))


def test_noise_is_found_whatever_its_size_and_jumps_are_none():
    for noise in (0.0, 1e-6, 1e-2):
        arrays, _, _ = log(noise=noise)
        for size in (0.0, 0.5):
            jumps = size * np.sign(np.sin(3 * arrays["t"]))[:, None]
            found = noise_of(arrays["q"] + jumps, arrays["trajectory"])
            assert found == pytest.approx([noise, noise], rel=0.1, abs=1e-7)
    # Noise is filtered in spite of jumps.
    arrays["q"][50::97, 0] += 0.05
    assert np.isfinite(smooth(from_arrays(arrays)).cutoff)


def test_steps_of_an_encoder_are_found_and_are_noise():
    arrays, _, _ = log(noise=0.0)
    step = 2 * np.pi / 4096
    stepped = np.round(arrays["q"] / step) * step
    assert step_of(stepped) == pytest.approx([step, step], rel=1e-6) and not step_of(arrays["q"]).any()
    assert (noise_of(stepped, arrays["trajectory"]) >= 0.999 * step / np.sqrt(12)).all()


def test_the_filter_has_its_gain_and_no_delay():
    t, frequencies = np.arange(2000) / RATE, np.array([2.0, 8.0, 10.0, 15.0])
    waves = np.sin(2 * np.pi * frequencies * t[:, None])
    # The bilinear map moves frequencies as tan(pi f / rate).
    mapped = np.tan(np.pi * frequencies / RATE) / np.tan(np.pi * 10.0 / RATE) * 10.0
    left = low_pass(waves, rate=RATE, cutoff=10.0)
    assert left[500:1500] == pytest.approx(gain(mapped, 10.0) * waves[500:1500], abs=1e-4)


def test_the_filter_is_linear():
    random = np.random.default_rng(0)
    columns, theta = random.normal(size=(200, 3)), random.normal(size=(3, 1))
    settings = {"rate": RATE, "cutoff": 7.0}
    left = low_pass(columns, **settings)
    assert low_pass(columns @ theta, **settings) == pytest.approx(left @ theta, abs=1e-9)


def test_derivatives_are_exact_for_polynomials_of_degree_five():
    t = np.arange(60) / RATE
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0, -1.0, 0.2])
    qd, qdd = derivatives(polynomial(t)[:, None], rate=RATE)
    assert qd[:, 0] == pytest.approx(polynomial.deriv()(t), abs=1e-9)
    assert qdd[:, 0] == pytest.approx(polynomial.deriv(2)(t), abs=1e-6)


def test_the_cut_off_is_nearly_the_best_there_is():
    for noise, rate in ((1e-5, 125.0), (1e-3, 40.0)):
        arrays, _, qdd = log(noise=noise, rate=rate)
        data = from_arrays(arrays)
        assert_nearly_best(data, "qdd", qdd, 0.5, np.geomspace(1.0, 0.4 * rate, 25))
        smoothed = smooth(data, trim=0.5)
        assert smoothed.noise_q == pytest.approx([noise, noise], rel=0.15)
        assert smoothed.noise_tau == pytest.approx([NOISE_TAU, NOISE_TAU], rel=0.15)


def test_lines_of_a_periodic_motion_are_not_cut_off_though_only_noise_is_between_them():
    t, order = np.arange(6000) / 500.0, np.arange(1, 60, 2)
    size, w = np.exp(-0.005 * order**2) / order**2, 2 * np.pi * order / 0.6  # a triangle with round corners
    q, qd = np.cos(w * t[:, None]) @ size, -np.sin(w * t[:, None]) @ (w * size)
    noise = 4e-4 * np.random.default_rng(0).normal(size=len(t))
    assert_nearly_best(one_channel(t, q + noise), "qd", qd[:, None], 1.0, np.geomspace(2.0, 100.0, 25))


def test_motions_of_a_motor_that_chatters_are_not_cut_off():
    """Accelerations have a shallow minimum at 5 Hz, and are as large from 20 to 60 Hz as below."""
    rate, count, random = 500.0, 6000, np.random.default_rng(0)
    f = np.fft.rfftfreq(count, 1 / rate)
    density = np.interp(np.log(np.maximum(f, 0.1)), np.log([0.3, 0.5, 3, 5, 20, 60, 100]), [0, 1, 1, 0.25, 1, 1, 0])
    spectrum = density * np.exp(2j * np.pi * random.uniform(size=len(f))) * np.sqrt(500 * rate * count / 2)
    w = 2 * np.pi * np.maximum(f, f[1])
    q, qd = (np.fft.irfft(part, count) for part in (-spectrum / w**2, spectrum / (1j * w)))
    data = one_channel(np.arange(count) / rate, q + 4e-4 * random.normal(size=count))
    assert_nearly_best(data, "qd", qd[:, None], 1.0, np.geomspace(2.0, 150.0, 25))


def test_commands_of_uneven_samples_keep_their_impulse_at_equal_steps():
    """Commands jump between ±1; a spline through them is wrong by half their size."""
    random = np.random.default_rng(0)
    t = (np.arange(300) + random.uniform(0, 0.6, 300)) / 100.0
    t[200:] += 0.1  # a gap
    u = random.choice([-1.0, 1.0], (300, 1))
    data = one_channel(t, np.sin(3 * t), u)
    even = held_at_equal_steps(data, 100.0)
    assert_allclose(even.q, np.sin(3 * even.t)[:, None], atol=1e-5)
    first = np.argmax(np.diff(even.t) > 0.015)
    assert_allclose(np.diff(even.t[: first + 1]), 0.01, atol=1e-12)
    fine = even.t[0] + 1e-5 * (np.arange(1000 * first) + 0.5)
    held = u[np.searchsorted(t, fine) - 1].reshape(-1, 1000).mean(axis=1)
    assert_allclose(even.tau[:first, 0], held, atol=4e-3)
    assert_array_equal(held_at_equal_steps(data._replace(t=np.arange(300) / 100.0)).tau, u)


def test_what_is_left_after_trimming_is_as_good_at_the_ends_as_in_the_middle():
    errors = []
    for seed in range(6):
        arrays, _, qdd = log(seed=seed, trajectories=4)
        smoothed = smooth(from_arrays(arrays), 4.0)
        inside = within(from_arrays(arrays), round(smoothed.trim * RATE))
        errors.append((smoothed.data.qdd - qdd[inside]).reshape(4, -1, 2))
    at = np.sqrt(np.mean(np.square(errors), axis=(0, 1, 3)))
    assert max(rms(at[:12]), rms(at[-12:])) < 2 * rms(at[400:600])


def test_clean_data_are_not_filtered():
    arrays, qd, qdd = log(noise=0.0)
    smoothed = smooth(from_arrays(arrays))
    assert np.isinf(smoothed.cutoff)
    assert np.array_equal(smoothed.data.q, arrays["q"])
    assert smoothed.data.qd == pytest.approx(qd, abs=1e-6)
    assert rms(smoothed.data.qdd - qdd) < 1e-3 * rms(qdd)


def test_uneven_samples_come_to_equal_steps():
    t = (np.arange(1250) + np.random.default_rng(1).uniform(-0.3, 0.3, 1250)) / RATE
    smoothed = smooth(from_arrays(log(t=t, noise=1e-5)[0]), trim=0.5)
    even = smoothed.data
    assert_allclose(np.diff(even.t)[np.diff(even.trajectory) == 0], 1 / smoothed.rate, rtol=1e-9)
    _, qd, qdd = motion(even.t + SECONDS * even.trajectory)
    assert np.all(np.std(even.qd - qd, axis=0) < 2e-3 * np.std(qd, axis=0))
    assert np.all(np.std(even.qdd - qdd, axis=0) < 0.03 * np.std(qdd, axis=0))


def test_long_gaps_cut_and_short_ones_are_bridged():
    arrays, _, _ = log()
    kept = np.delete(np.arange(len(arrays["t"])), np.r_[200:202, 1750:1950])  # two samples of run0, 1.6 s of run1
    smoothed = smooth(from_arrays({key: x if key == "label" else x[kept] for key, x in arrays.items()}), 8.0)
    assert (smoothed.parts, smoothed.left_out) == (4, 0)
    assert list(smoothed.data.label) == ["run0", "run1/1", "run1/2", "run2"]
    assert labels_of_parts(smoothed.data, ["run1", "run2", "other"]) == ["run1/1", "run1/2", "run2", "other"]
    steps = np.diff(smoothed.data.t)[np.diff(smoothed.data.trajectory) == 0]
    assert steps.max() < 1.01 / smoothed.rate
    assert np.sum(smoothed.data.trajectory == 0) == 1250 - 2 * round(smoothed.trim * smoothed.rate)


def test_decimated_torques_are_filtered_and_others_are_not():
    data = from_arrays(log()[0])
    whole, few = smooth(data, 6.0), smooth(data, 6.0, decimate=5)
    assert not whole.filtered_torque and few.filtered_torque
    assert np.array_equal(few.data.t, np.concatenate([whole.data.t[whole.data.trajectory == k][::5] for k in range(3)]))
    assert (few.noise_tau < 0.5 * whole.noise_tau).all()
    assert few.data.estimated == ()


def test_what_cannot_be_filtered_is_one_line():
    data = from_arrays(log()[0])
    noise = 1e-4 * np.random.default_rng(0).normal(size=data.q.shape)
    for message, settings in {
        "expected less than 62.5 Hz": {"cutoff": 80.0},
        "cutoff is -1.0": {"cutoff": -1.0},
        "more than twice the cut-off": {"cutoff": 10.0, "decimate": 8},
        "longer motions": {"cutoff": 0.1},
        "trim is -0.1": {"trim": -0.1},
    }.items():
        with one_line(message):
            smooth(data, **settings)
    with one_line("moves by more than its noise"):
        smooth(data._replace(q=noise))


def test_noise_of_torques_is_told_only_from_samples_close_together():
    t = np.arange(0, 20, 0.01)
    data = one_channel(
        t, np.sin(3 * t), 5 * np.sin(2 * t)[:, None] + 0.1 * np.random.default_rng(0).normal(size=(2000, 1))
    )
    assert_allclose(torque_noise(data), 0.1, rtol=0.1)
    assert torque_noise(every(data, 60)) is None
    assert torque_noise(data._replace(trajectory=np.arange(len(t)))) is None


def test_one_repeated_row_in_a_hundred_does_not_change_the_cutoff():
    for rate, noise, keys in ((30.0, 1e-3, ("q", "tau")), (125.0, 1e-5, ("q",))):
        arrays, _, qdd = log(rate=rate, noise=noise)
        clean = smooth(from_arrays(arrays), trim=1.0)
        rows = np.arange(101, len(qdd) - 5, 101)
        for key in keys:
            arrays[key][rows] = arrays[key][rows - 1]
        smoothed = smooth(from_arrays(arrays), trim=1.0)
        assert np.array_equal(np.flatnonzero(smoothed.repeats.q), rows)
        assert smoothed.cutoff == pytest.approx(clean.cutoff, rel=0.05)
        inside = within(from_arrays(arrays), round(rate))
        assert rms(smoothed.data.qdd - qdd[inside]) < 1.3 * rms(clean.data.qdd - qdd[inside])


def test_inserted_rows_give_their_time_back():
    arrays, _, _ = log(t=np.arange(720) / 30.0, trajectories=1)
    order = np.sort(np.r_[:720, 46:690:49])
    longer = {key: arrays[key][order] for key in ("q", "tau", "trajectory")}
    inserted = from_arrays({**longer, "t": np.arange(len(order)) / 30.0})
    data, repeats = without_repeats(inserted)
    assert repeats.inserted and repeats.rows.sum() == len(order) - 720
    assert np.array_equal(data.q, arrays["q"])
    assert np.ptp(np.diff(data.t)) < 1e-9 and data.t[1] > 1 / 30.0
    assert smooth(inserted).cutoff == pytest.approx(smooth(from_arrays(arrays)).cutoff, rel=0.05)


def test_rest_and_turning_points_are_no_repeats():
    t = np.arange(400) / 100.0
    symmetric = np.cos(2 * np.pi * (t - 0.005))  # equal on both sides of every turning point
    resting = np.where(t < 2.0, 1.0, 1.0 - 0.5 * (t - 2.0) ** 2)
    stepped = np.round(np.sin(t) / 0.01) * 0.01  # an encoder so coarse that it often reads the same twice
    for q, sign in ((symmetric, -1), (resting, 1), (stepped, 1)):
        assert not find_repeats(q[:, None], sign * q[:, None], np.zeros(400, int)).q.any()
