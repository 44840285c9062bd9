"""Logs of encoders: noise, filter, derivatives and cut-off against closed forms, and what gaps and jitter become."""

import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.encoders import (
    derivatives,
    labels_of_parts,
    low_pass,
    noise_of,
    sampling,
    smooth,
    step_of,
    torque_noise,
)
from dln_jax.data.encoders.filters import gain
from dln_jax.data.splits import every
from dln_jax.types import InputError

RATE, SECONDS = 125.0, 10.0
NOISE_Q, NOISE_TAU = 1e-4, 0.2


def motion(t, joint):
    """q, qd and qdd of a joint: a few slow sines."""
    random = np.random.default_rng(joint)
    w = 2 * np.pi * np.array([0.2, 0.5, 1.1, 1.7])[:, None]
    a, b = random.uniform(-1, 1, (2, 4, 1)) / (1 + w)
    sine, cosine = np.sin(w * t), np.cos(w * t)
    return (
        (a * sine + b * cosine).sum(axis=0),
        (w * (a * cosine - b * sine)).sum(axis=0),
        (-(w**2) * (a * sine + b * cosine)).sum(axis=0),
    )


def log(*, noise=NOISE_Q, rate=RATE, trajectories=3, t=None, seed=0, d=2):
    """Arrays of a log and the true rates; its trajectories follow each other in one long motion."""
    random = np.random.default_rng(seed)
    t = np.arange(round(SECONDS * rate)) / rate if t is None else t
    parts = [[motion(t + SECONDS * k, joint) for joint in range(d)] for k in range(trajectories)]
    q, qd, qdd = (np.concatenate([np.stack([joint[i] for joint in part], 1) for part in parts]) for i in range(3))
    tau = qdd + 0.3 * qd
    arrays = {
        "t": np.tile(t, trajectories),
        "q": q + noise * random.normal(size=q.shape),
        "tau": tau + NOISE_TAU * random.normal(size=q.shape),
        "trajectory": np.repeat(np.arange(trajectories), len(t)),
        "label": np.array([f"run{k}" for k in range(trajectories)]),
    }
    return arrays, qd, qdd


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 1e-2])
def test_noise_is_found_whatever_its_size(noise):
    arrays, _, _ = log(noise=noise)
    assert noise_of(arrays["q"], arrays["trajectory"]) == pytest.approx([noise, noise], rel=0.1)


def test_noise_of_a_smooth_signal_is_nothing_and_jumps_are_none():
    arrays, _, _ = log(noise=0.0)
    jumps = arrays["q"] + 0.5 * np.sign(np.sin(3 * arrays["t"]))[:, None]
    for values in (arrays["q"], jumps):
        assert (noise_of(values, arrays["trajectory"]) < 1e-7).all()


def test_steps_of_an_encoder_are_found_and_are_noise():
    arrays, _, _ = log(noise=0.0)
    step = 2 * np.pi / 4096
    stepped = np.round(arrays["q"] / step) * step
    assert step_of(stepped) == pytest.approx([step, step], rel=1e-6)
    assert not step_of(arrays["q"]).any()
    assert (noise_of(stepped, arrays["trajectory"]) >= 0.999 * step / np.sqrt(12)).all()


@pytest.mark.parametrize("frequency", [2.0, 8.0, 10.0, 15.0])
def test_the_filter_has_its_gain_and_no_delay(frequency):
    t = np.arange(2000) / RATE
    wave = np.sin(2 * np.pi * frequency * t)[:, None]
    left = low_pass(wave, rate=RATE, cutoff=10.0)[500:1500, 0]
    # The bilinear map moves frequencies as tan(pi f / rate).
    mapped = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 10.0 / RATE) * 10.0
    expected = float(gain(np.array([mapped]), 10.0)[0])
    assert left == pytest.approx(expected * wave[500:1500, 0], abs=1e-4)


def test_the_filter_commutes_with_what_is_linear():
    random = np.random.default_rng(0)
    columns, theta = random.normal(size=(400, 3)), random.normal(size=(3, 1))
    part = np.repeat([0, 1], 200)
    settings = {"rate": RATE, "cutoff": 7.0, "trajectory": part}
    assert low_pass(columns @ theta, **settings) == pytest.approx(low_pass(columns, **settings) @ theta, abs=1e-9)
    alone = low_pass(columns[:200], rate=RATE, cutoff=7.0)
    assert np.array_equal(low_pass(columns, **settings)[:200], alone)


def test_derivatives_are_exact_for_polynomials_of_degree_five():
    t = np.arange(60) / RATE
    coefficients = np.array([1.0, -2.0, 0.5, 3.0, -1.0, 0.2])
    polynomial = np.polynomial.Polynomial(coefficients)
    qd, qdd = derivatives(polynomial(t)[:, None], rate=RATE)
    assert qd[:, 0] == pytest.approx(polynomial.deriv()(t), abs=1e-9)
    assert qdd[:, 0] == pytest.approx(polynomial.deriv(2)(t), abs=1e-6)


@pytest.mark.parametrize("noise", [1e-5, 1e-3])
@pytest.mark.parametrize("rate", [125.0, 40.0])
def test_the_cut_off_is_nearly_the_best_there_is(noise, rate):
    arrays, _, qdd = log(noise=noise, rate=rate)
    data = schema.from_arrays(arrays)

    def error(cutoff):
        smoothed = smooth(data, cutoff, trim=0.5)
        return rms(smoothed.data.qdd - qdd[within(data, round(0.5 * rate))]), smoothed

    chosen, smoothed = error(None)
    best = min(error(cutoff)[0] for cutoff in np.geomspace(1.0, 0.4 * rate, 25))
    assert chosen < 1.25 * best
    assert smoothed.noise_q == pytest.approx([noise, noise], rel=0.15)
    assert smoothed.noise_tau == pytest.approx([NOISE_TAU, NOISE_TAU], rel=0.15)


@pytest.mark.parametrize("period", [0.6, 1.3])
def test_lines_of_a_periodic_motion_are_not_cut_off_though_only_noise_is_between_them(period):
    rate, random = 500.0, np.random.default_rng(0)
    t = np.arange(6000) / rate
    # A triangle with round corners, of odd harmonics only.
    order = np.arange(1, 60, 2)
    size, w = np.exp(-0.005 * order**2) / order**2, 2 * np.pi * order / period
    q, qd = np.cos(w * t[:, None]) @ size, -np.sin(w * t[:, None]) @ (w * size)
    measured = (q + 4e-4 * random.normal(size=len(t)))[:, None]
    numbers = {"trajectory": np.zeros(len(t), int), "label": np.array(["run0"])}
    data = schema.from_arrays({"t": t, "q": measured, "tau": np.zeros((len(t), 1)), **numbers})

    def error(cutoff):
        return rms(smooth(data, cutoff, trim=1.0).data.qd[:, 0] - qd[500:-500])

    assert error(None) < 1.25 * min(error(cutoff) for cutoff in np.geomspace(2.0, 100.0, 25))


def test_commands_of_uneven_samples_keep_their_impulse_at_equal_steps():
    """Commands jump between ±1; a spline through them is wrong by half their size."""
    random = np.random.default_rng(0)
    t = (np.arange(300) + random.uniform(0, 0.6, 300)) / 100.0
    t[200:] += 0.1  # a gap
    u, q = random.choice([-1.0, 1.0], (300, 1)), np.sin(3 * t)[:, None]
    numbers = {"trajectory": np.zeros(300, int), "label": np.array(["run0"])}
    data = schema.from_arrays({"t": t, "q": q, "tau": u, **numbers})
    even = sampling.held_at_equal_steps(data, 100.0)
    first, second = np.split(np.arange(len(even.t)), np.flatnonzero(np.diff(even.t) > 0.015) + 1)
    np.testing.assert_allclose(np.diff(even.t[first]), 0.01, atol=1e-12)
    np.testing.assert_allclose(even.q, np.sin(3 * even.t)[:, None], atol=1e-5)
    for rows, part in ((first, slice(0, 200)), (second, slice(200, 300))):
        fine = even.t[rows[0]] + 1e-5 * (np.arange(1000 * (len(rows) - 1)) + 0.5)
        held = u[part][np.searchsorted(t[part], fine, side="right") - 1].reshape(-1, 1000).mean(axis=1)
        np.testing.assert_allclose(even.tau[rows[:-1], 0], held, atol=4e-3)
    already = data._replace(t=np.arange(300) / 100.0)
    np.testing.assert_array_equal(sampling.held_at_equal_steps(already).tau, u)


def test_motions_of_a_motor_that_chatters_are_not_cut_off():
    """Accelerations have a shallow minimum at 5 Hz, and are as large from 20 to 60 Hz as below."""
    rate, count, random = 500.0, 6000, np.random.default_rng(0)
    f = np.fft.rfftfreq(count, 1 / rate)
    density = np.interp(np.log(np.maximum(f, 0.1)), np.log([0.3, 0.5, 3, 5, 20, 60, 100]), [0, 1, 1, 0.25, 1, 1, 0])
    spectrum = density * np.exp(2j * np.pi * random.uniform(size=len(f))) * np.sqrt(500 * rate * count / 2)
    w = 2 * np.pi * np.maximum(f, f[1])
    q, qd = (np.fft.irfft(part, count) for part in (-spectrum / w**2, spectrum / (1j * w)))
    measured = (q + 4e-4 * random.normal(size=count))[:, None]
    numbers = {"trajectory": np.zeros(count, int), "label": np.array(["run0"])}
    data = schema.from_arrays({"t": np.arange(count) / rate, "q": measured, "tau": np.zeros((count, 1)), **numbers})

    def error(cutoff):
        return rms(smooth(data, cutoff, trim=1.0).data.qd[:, 0] - qd[500:-500])

    assert error(None) < 1.25 * min(error(cutoff) for cutoff in np.geomspace(2.0, 150.0, 25))


def test_rates_of_filtered_encoders_are_far_better_than_differences():
    arrays, qd, qdd = log()
    data = schema.from_arrays(arrays)
    smoothed = smooth(data)
    inside = within(data, round(smoothed.trim * RATE))
    assert rms(smoothed.data.qdd - qdd[inside]) < 0.02 * rms((data.qdd - qdd)[inside])
    assert rms(smoothed.data.qd - qd[inside]) < 0.1 * rms((data.qd - qd)[inside])


def test_what_is_left_after_trimming_is_as_good_at_the_ends_as_in_the_middle():
    errors = []
    for seed in range(6):
        arrays, _, qdd = log(seed=seed, trajectories=4)
        data = schema.from_arrays(arrays)
        smoothed = smooth(data, 5.0)
        errors.append((smoothed.data.qdd - qdd[within(data, round(smoothed.trim * RATE))]).reshape(4, -1, 2))
    at = np.sqrt(np.mean(np.square(errors), axis=(0, 1, 3)))
    assert max(rms(at[:12]), rms(at[-12:])) < 2 * rms(at[400:600])


def within(data, ends):
    """Samples away from the ends of their trajectories."""
    return np.concatenate([np.flatnonzero(data.trajectory == k)[ends:-ends] for k in np.unique(data.trajectory)])


def test_clean_data_are_not_filtered():
    arrays, qd, qdd = log(noise=0.0)
    smoothed = smooth(schema.from_arrays(arrays))
    assert np.isinf(smoothed.cutoff)
    assert np.array_equal(smoothed.data.q, arrays["q"])
    assert smoothed.data.qd == pytest.approx(qd, abs=1e-6)
    assert rms(smoothed.data.qdd - qdd) < 1e-3 * rms(qdd)


def test_uneven_samples_come_to_equal_steps():
    random = np.random.default_rng(1)
    t = np.sort(np.arange(1250) / RATE + random.uniform(-0.3, 0.3, 1250) / RATE)
    arrays, _, _ = log(t=t, noise=1e-5)
    data = schema.from_arrays(arrays)
    assert sampling.timing(data.t, data.trajectory).jitter > 0.1
    smoothed = smooth(data, trim=0.5)
    steps = np.diff(smoothed.data.t)[np.diff(smoothed.data.trajectory) == 0]
    assert steps == pytest.approx(np.full(len(steps), 1 / smoothed.rate), rel=1e-9)
    for k in range(3):
        here = smoothed.data.trajectory == k
        for joint in range(2):
            _, qd, qdd = motion(smoothed.data.t[here] + SECONDS * k, joint)
            assert rms(smoothed.data.qd[here, joint] - qd) < 2e-3 * rms(qd)
            assert rms(smoothed.data.qdd[here, joint] - qdd) < 0.03 * rms(qdd)


def test_long_gaps_cut_and_short_ones_are_bridged():
    arrays, _, _ = log()
    lost = np.zeros(len(arrays["t"]), bool)
    lost[200:202] = True  # two samples of run0
    lost[1250 + 500 : 1250 + 700] = True  # 1.6 s of run1
    data = schema.from_arrays({key: x if key == "label" else x[~lost] for key, x in arrays.items()})
    smoothed = smooth(data, 8.0)
    assert (smoothed.bridged, smoothed.parts, smoothed.left_out) == (1, 4, 0)
    assert list(smoothed.data.label) == ["run0", "run1/1", "run1/2", "run2"]
    assert labels_of_parts(smoothed.data, ["run1", "run2", "other"]) == ["run1/1", "run1/2", "run2", "other"]
    steps = np.diff(smoothed.data.t)[np.diff(smoothed.data.trajectory) == 0]
    assert steps.max() < 1.01 / smoothed.rate
    first = smoothed.data.trajectory == 0
    assert np.sum(first) == 1250 - 2 * round(smoothed.trim * smoothed.rate)


def test_decimated_torques_are_filtered_and_others_are_not():
    data = schema.from_arrays(log()[0])
    whole, few = smooth(data, 6.0), smooth(data, 6.0, decimate=5)
    assert not whole.filtered_torque and few.filtered_torque
    assert np.array_equal(few.data.t, np.concatenate([whole.data.t[whole.data.trajectory == k][::5] for k in range(3)]))
    assert (few.noise_tau < 0.5 * whole.noise_tau).all()
    assert few.data.estimated == ()


REFUSED = [
    ({"cutoff": 80.0}, "expected less than 62.5 Hz"),
    ({"cutoff": -1.0}, "cutoff is -1.0"),
    ({"cutoff": 10.0, "decimate": 8}, "more than twice the cut-off"),
    ({"decimate": 0}, "decimate is 0"),
    ({"cutoff": 0.1}, "longer motions"),
    ({"trim": -0.1}, "trim is -0.1"),
]


@pytest.mark.parametrize(("settings", "message"), REFUSED)
def test_what_cannot_be_filtered_is_one_line(settings, message):
    with pytest.raises(InputError, match=message) as refusal:
        smooth(schema.from_arrays(log()[0]), **settings)
    assert "\n" not in str(refusal.value)


def test_motions_within_noise_have_no_cut_off():
    arrays, _, _ = log()
    noise = np.random.default_rng(0).normal(size=arrays["q"].shape)
    with pytest.raises(InputError, match="moves by more than its noise"):
        smooth(schema.from_arrays({**arrays, "q": 1e-4 * noise}))


def test_noise_of_torques_is_told_only_from_samples_close_together():
    t = np.arange(0, 20, 0.01)
    motion = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    tau = 5 * motion + 0.1 * np.random.default_rng(0).normal(size=motion.shape)
    data = schema.from_arrays(
        {"t": t, "q": motion, "qd": motion, "qdd": motion, "tau": tau, "trajectory": np.zeros(len(t), int)}
    )
    np.testing.assert_allclose(torque_noise(data), 0.1, rtol=0.1)
    assert torque_noise(every(data, 60)) is None
    assert torque_noise(data._replace(trajectory=np.arange(len(t)))) is None
