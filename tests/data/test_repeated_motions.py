"""Recordings of one motion are found, whatever part they show, and stay on one side of a split."""

import numpy as np
import pytest

from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import hold_out, split


def fourier(random, d, samples=400):
    """A smooth random motion of d joints."""
    t, harmonics = np.linspace(0, 2 * np.pi, samples), np.arange(1, 6)
    sines, cosines = random.normal(size=(2, 5, d)) / harmonics[:, None]
    return np.sin(np.outer(t, harmonics)) @ sines + np.cos(np.outer(t, harmonics)) @ cosines


def trajectories(motions):
    """The schema's arrays of motions that are sampled at 100 Hz."""
    q, lengths = np.concatenate(motions), [len(motion) for motion in motions]
    number = np.repeat(np.arange(len(motions)), lengths)
    t = np.concatenate([np.arange(length) / 100 for length in lengths])
    rates = np.concatenate([np.gradient(motion, 0.01, axis=0) for motion in motions])
    tau = np.random.default_rng(9).normal(size=q.shape)
    return from_arrays({"q": q, "qd": rates, "qdd": 0 * q, "tau": tau, "t": t, "trajectory": number})


def recorded(random, d=3, motions=6, times=3):
    """Every motion, recorded several times: from a later start, with an offset and noise."""
    rows = []
    for _ in range(motions):
        motion = fourier(random, d)
        for _ in range(times):
            part = motion[random.integers(0, 40) :]
            rows.append(part + 0.02 * random.normal(size=d) + 1e-3 * random.normal(size=part.shape))
    return trajectories(rows)


@pytest.mark.parametrize("d", [2, 3, 7])
def test_recordings_of_one_motion_have_its_number(d):
    data = recorded(np.random.default_rng(d), d)
    assert motion_numbers(data.q, data.trajectory).tolist() == np.repeat(np.arange(6), 3).tolist()


@pytest.mark.parametrize("d", [2, 3, 7])
def test_different_motions_never_count_as_one(d):
    random = np.random.default_rng(d)
    for _ in range(10):
        data = trajectories([fourier(random, d) for _ in range(20)])
        assert len(np.unique(motion_numbers(data.q, data.trajectory))) == 20


def test_the_same_path_at_another_speed_is_another_motion():
    motion = fourier(np.random.default_rng(0), 3)
    data = trajectories([motion, motion[::2], motion + 0.01])
    assert motion_numbers(data.q, data.trajectory).tolist() == [0, 1, 0]


def test_swings_of_one_coordinate_and_bodies_at_rest_are_motions_of_their_own():
    swings = trajectories([np.sin(np.linspace(0, 9, 200))[:, None]] * 3)
    assert motion_numbers(swings.q, swings.trajectory).tolist() == [0, 1, 2]
    still = trajectories([np.ones((100, 2))] * 2 + [fourier(np.random.default_rng(0), 2)])
    assert motion_numbers(still.q, still.trajectory).tolist() == [0, 1, 2]


def test_absent_trajectories_have_no_motion():
    motion = fourier(np.random.default_rng(0), 2)
    assert motion_numbers(np.concatenate([motion, motion]), np.repeat([1, 3], len(motion))).tolist() == [-1, 0, -1, 0]


def test_a_split_keeps_recordings_of_one_motion_together():
    data = recorded(np.random.default_rng(0), motions=8)
    motion = motion_numbers(data.q, data.trajectory)
    for seed in range(4):
        sets = split(data, seed=seed, motion=motion)
        shown = [set(motion[np.unique(part.trajectory)].tolist()) for part in sets]
        assert all(shown) and not shown[0] & shown[1] and not (shown[0] | shown[1]) & shown[2]
        assert "show 8 motions" in remark_on_repeats([sets.train, sets.validation], sets.test, motion)


def test_the_motion_with_fewest_recordings_is_held_out_if_the_choice_is_most_of_the_data():
    random = np.random.default_rng(0)
    often, few = fourier(random, 3), [fourier(random, 3) for _ in range(2)]
    data = trajectories([few[0], few[1], *[often + 1e-3 * k for k in range(7)]])
    sets = split(data, motion=motion_numbers(data.q, data.trajectory))
    assert np.unique(sets.test.trajectory).tolist() == [1], "the last of the two that were recorded once"


def test_without_repeats_splits_are_what_they_were():
    random = np.random.default_rng(0)
    data = trajectories([fourier(random, 3) for _ in range(12)])
    motion = motion_numbers(data.q, data.trajectory)
    for seed in range(3):
        test = np.unique(split(data, seed=seed, motion=motion).test.trajectory)
        drawn = np.random.default_rng(seed).choice(np.arange(12), size=4, replace=False)
        assert test.tolist() == [5, 11]
        for numbers in (None, motion):
            held = np.unique(hold_out(data, 0.3, seed, numbers)[1].trajectory)
            assert held.tolist() == sorted(drawn.tolist())


def test_a_test_that_repeats_trained_motions_is_remarked():
    data = recorded(np.random.default_rng(0), motions=4)
    sets = split(data, test=["0", "11"])
    line = remark_on_repeats([sets.train, sets.validation], sets.test)
    assert line.startswith("warning: 2 of 2 held-out motions repeat trained ones, such as '0' and '1'")
    one = recorded(np.random.default_rng(0), motions=1, times=6)
    sets = split(one, motion=motion_numbers(one.q, one.trajectory))
    assert "repeat trained ones" in remark_on_repeats([sets.train, sets.validation], sets.test), "all show one motion"
