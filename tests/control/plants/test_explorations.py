"""Explorations keep to the limits and record what the hardware has."""

import numpy as np
import pytest
from calls import one_line
from furuta import LAYOUT, LIMIT, STEP, simulated_furuta

from dln_jax.control.plants.exploring import Exploration, explore, smooth_noise
from dln_jax.data import schema

BLIND = Exploration(seconds=3.0, blind=(0.3, 0.6), surplus=())


def unused(recording):
    raise AssertionError("blind episodes need no model")


def test_recording_stays_within_the_limits_and_is_a_file_of_encoder_readings(tmp_path):
    recording = explore(simulated_furuta(seed=1), unused, BLIND, seed=1).recording
    assert np.abs(recording.tau[:, 0]).max() <= BLIND.share * LIMIT + 1e-12
    assert np.ptp(recording.q[:, 0]) > 0.1 and (recording.tau[:, 1] == 0).all()
    steps = recording.q / STEP
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    schema.save(tmp_path / "data.npz", recording)
    read = schema.load(tmp_path / "data.npz")
    assert read.estimated == ("qd", "qdd") and read.needs == LAYOUT.needs and len(read.t) == 1500


def test_the_rest_of_a_stopped_episode_is_tried_once_more_with_half_of_the_noise():
    """The plant answers NaN 0.5 s after its first reset, and is sound after the second."""
    plant = simulated_furuta(seed=1)
    resets = []

    def read():
        broken = len(resets) == 1 and plant.time() > resets[0] + 0.5
        return np.full(2, np.nan) if broken else plant.read()

    def reset():
        plant.reset()
        resets.append(plant.time())

    settings = BLIND._replace(seconds=4.0)
    explored = explore(plant._replace(read=read, reset=reset), unused, settings, seed=1)
    # Half a second is too short to be kept; the others are the rest of the first episode, and the second one.
    assert len(explored.stopped) == 1 and len(resets) == 3
    lengths = np.bincount(explored.recording.trajectory)
    np.testing.assert_allclose(lengths / LAYOUT.rate, [1.5, 2.0], atol=0.01)
    undisturbed = explore(simulated_furuta(seed=1), unused, settings, seed=1).recording
    second = [one.tau[one.trajectory == 1, 0].std() for one in (explored.recording, undisturbed)]
    assert second[0] < 0.7 * second[1]


def test_noise_has_unit_variance_below_its_bandwidth():
    noise = smooth_noise((4000, 2), rate=500.0, bandwidth=3.0, random=np.random.default_rng(0))
    power = np.abs(np.fft.rfft(noise, axis=0)) ** 2
    assert noise.std() == pytest.approx(1.0, rel=0.01) and power[100:].sum() < 0.02 * power.sum()


def test_settings_out_of_range_are_refused():
    with one_line("seconds is -1"):
        explore(simulated_furuta(), unused, BLIND._replace(seconds=-1.0))
