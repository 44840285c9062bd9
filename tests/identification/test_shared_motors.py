"""A motor that turns with two joints is found in what a fit leaves unexplained, and only there."""

import numpy as np
import pytest

from dln_jax.identification.shared_motors import shared_motor


def rates(random, d=4, samples=2000):
    t = np.linspace(0, 20, samples)
    frequencies, phases = random.uniform(0.2, 1.5, size=(2, 4, d))
    return np.cos(2 * np.pi * np.multiply.outer(t, frequencies) + 6 * phases).sum(axis=1)


def friction(rate, viscous, coulomb):
    return viscous * rate + coulomb * np.tanh(rate / 0.05)


@pytest.mark.parametrize(("joint", "other", "ratio"), [(3, 2, 1.0), (3, 2, -0.5), (2, 1, 1.5), (1, 0, -1.0)])
def test_a_motor_of_two_joints_is_found(joint, other, ratio):
    random = np.random.default_rng(joint)
    qd = rates(random)
    left = 0.3 * random.normal(size=qd.shape)
    torque = friction(qd[:, joint] + ratio * qd[:, other], 0.4, 1.5)
    left[:, joint] += torque - friction(qd[:, joint], 0.3, 1.0)  # a fit explains part of it by the joints' own rates
    left[:, other] += ratio * torque - friction(qd[:, other], 0.2, 0.5)
    motor = shared_motor(left, qd)
    assert motor is not None and motor[:3] == (joint, other, ratio) and 0.3 <= motor.share <= 1


def test_the_rows_of_the_rates_are_those_of_the_option():
    motor = shared_motor(*of_wrist())
    assert motor is not None and motor.rates(2).tolist() == [[1, 0], [1, 1]]


def of_wrist():
    qd = rates(np.random.default_rng(0), d=2)
    torque = friction(qd.sum(axis=1), 0.5, 1.0)[:, None] * np.ones(2)
    return torque, qd


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_found_in_friction_of_single_joints_or_in_noise(seed):
    random = np.random.default_rng(seed)
    qd = rates(random)
    noise = random.normal(size=qd.shape)
    stribeck = noise * 0.2 + np.tanh(qd / 0.02) * np.exp(-((qd / 0.3) ** 2))
    slow = np.cumsum(noise, axis=0) / 30
    for left in (noise, stribeck, slow, 0 * noise):
        assert shared_motor(left, qd) is None


def test_a_single_joint_has_no_shared_motor():
    assert shared_motor(np.ones((100, 1)), np.ones((100, 1))) is None
