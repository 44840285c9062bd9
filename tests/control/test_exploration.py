"""Exploration keeps to the limits, records what the hardware has, and finds motions all around."""

import numpy as np
import pytest

from dln_jax.control.desktop_plants import desktop_plant
from dln_jax.control.exploration import Excitation, explore, smooth_noise
from dln_jax.data import schema
from dln_jax.types import InputError

PLANT = desktop_plant("furuta")
EXCITATION = Excitation(seconds=3.0, episodes=2)


@pytest.fixture(scope="module")
def explored():
    quiet = PLANT._replace(hardware=PLANT.hardware._replace(control_noise=0.0))
    return explore(quiet, PLANT.numbers.gains, EXCITATION, seed=1)


def test_torques_keep_to_the_limits_and_are_those_that_arrive_late(explored):
    data, runs = explored
    asked = data.tau[:, 0].reshape(2, -1)
    assert np.abs(asked).max() <= EXCITATION.share * PLANT.hardware.upper
    assert (data.tau[:, 1] == 0).all()
    np.testing.assert_allclose(runs.u[:, 1:, 0], asked[:, :-1], atol=1e-12)
    assert (runs.u[:, 0] == 0).all()


def test_what_is_recorded_is_a_file_of_encoders_readings(explored, tmp_path):
    data, runs = explored
    steps = data.q / PLANT.hardware.encoder_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    assert np.abs(data.q - runs.x[:, :-1, :2].reshape(-1, 2)).max() <= PLANT.hardware.encoder_step.max()
    schema.save(tmp_path / "data.npz", data)
    read = schema.load(tmp_path / "data.npz")
    assert read.estimated == ("qd", "qdd") and read.needs == PLANT.scene.needs and len(read.t) == 1500


def test_noise_is_smooth():
    noise = smooth_noise((4000, 2), rate=500.0, bandwidth=3.0, random=np.random.default_rng(0))
    power = np.abs(np.fft.rfft(noise, axis=0)) ** 2
    assert noise.std() == pytest.approx(1.0, rel=0.01) and power[100:].sum() < 0.02 * power.sum()


def test_mistakes_are_one_line():
    with pytest.raises(InputError, match="seconds is -1"):
        explore(PLANT, PLANT.numbers.gains, Excitation(seconds=-1.0))
    with pytest.raises(InputError, match="choose from cart-pole, rotary-pendulum, furuta"):
        desktop_plant("dance")
