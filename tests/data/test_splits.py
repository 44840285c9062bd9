"""Recordings of one motion are found and stay on one side of a split; held-out parts can be stated."""

import numpy as np
from calls import one_line
from numpy.testing import assert_array_equal

from dln_jax.commands.phase_spaces.data import split_test
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import hold_out, in_blocks, split, stated_test


def fourier(random, d=3):
    """A smooth random motion of d joints."""
    angles = np.outer(np.linspace(0, 2 * np.pi, 400), np.arange(1, 6))
    sines, cosines = random.normal(size=(2, 5, d)) / np.arange(1, 6)[:, None]
    return np.sin(angles) @ sines + np.cos(angles) @ cosines


def trajectories(motions):
    """Data of motions that are sampled at 100 Hz."""
    q = np.concatenate(motions)
    number = np.repeat(np.arange(len(motions)), [len(motion) for motion in motions])
    t = np.concatenate([np.arange(len(motion)) / 100 for motion in motions])
    return from_arrays({"q": q, "tau": q, "t": t, "trajectory": number})


def recorded(random, d=3, motions=6, times=3):
    """Every motion, recorded several times: from a later start, with an offset and noise."""
    rows = []
    for _ in range(motions):
        motion = fourier(random, d)
        for _ in range(times):
            part = motion[random.integers(0, 40) :]
            rows.append(part + 0.02 * random.normal(size=d) + 1e-3 * random.normal(size=part.shape))
    return trajectories(rows)


def numbers_of(motions):
    data = trajectories(motions)
    return motion_numbers(data.q, data.trajectory).tolist()


def test_recordings_of_one_motion_have_its_number_and_others_never_count_as_one():
    for d in (2, 7):
        random = np.random.default_rng(d)
        data = recorded(random, d)
        assert motion_numbers(data.q, data.trajectory).tolist() == np.repeat(np.arange(6), 3).tolist()
        for _ in range(10):
            assert numbers_of([fourier(random, d) for _ in range(20)]) == list(range(20))


def test_other_speeds_bodies_at_rest_and_swings_of_one_coordinate_are_motions_of_their_own():
    motion = fourier(np.random.default_rng(0))
    assert numbers_of([motion, motion[::2], motion + 0.01]) == [0, 1, 0]
    assert numbers_of([np.sin(np.linspace(0, 9, 200))[:, None]] * 3) == [0, 1, 2]
    assert numbers_of([*[np.ones((100, 3))] * 2, motion]) == [0, 1, 2]
    absent = motion_numbers(np.concatenate([motion, motion]), np.repeat([1, 3], len(motion)))
    assert absent.tolist() == [-1, 0, -1, 0]


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
    often, *few = (fourier(random) for _ in range(3))
    data = trajectories([*few, *[often + 1e-3 * k for k in range(7)]])
    sets = split(data, motion=motion_numbers(data.q, data.trajectory))
    assert np.unique(sets.test.trajectory).tolist() == [1], "the last of the two that were recorded once"


def test_without_repeats_splits_are_what_they_were():
    random = np.random.default_rng(0)
    data = trajectories([fourier(random) for _ in range(12)])
    motion = motion_numbers(data.q, data.trajectory)
    assert np.unique(split(data, seed=1, motion=motion).test.trajectory).tolist() == [5, 11]
    one, other = (hold_out(data, 0.3, 1, numbers)[1] for numbers in (None, motion))
    assert_array_equal(one.q, other.q)


def test_a_test_that_repeats_trained_motions_is_remarked():
    data = recorded(np.random.default_rng(0), motions=4)
    sets = split(data, test=["0", "11"])
    line = remark_on_repeats([sets.train, sets.validation], sets.test)
    assert line.startswith("warning: 2 of 2 held-out motions repeat trained ones, such as '0' and '1'")


def log(*counts):
    q = np.random.default_rng(0).normal(size=(sum(counts), 1))
    return trajectories(np.split(q, np.cumsum(counts)[:-1]))


def test_the_last_part_of_every_trajectory_is_held_out():
    data = log(100, 50)
    cut, labels = stated_test(data, "last:30%")
    assert labels == ["0[last]", "1[last]"]
    sets = split(cut, test=labels)
    late = np.where(data.trajectory == 0, data.t >= 0.7, data.t >= 0.35)
    assert_array_equal(np.sort(sets.test.q, axis=0), np.sort(data.q[late], axis=0))
    assert len(sets.train.t) + len(sets.validation.t) == np.sum(~late)


def test_one_trajectory_suffices_for_both():
    data = log(200)
    for text, tested in (("last:20%", 40), ("blocks", 20)):
        cut, labels = stated_test(data, text)
        sets = split(cut, test=labels)
        assert len(sets.test.t) == tested and len(sets.validation.t) and len(sets.train.t) > 100
        assert [len(part.t) for part in split_test(data, "log", text, 30)[:2]] == [200 - tested, tested]
    blocks = in_blocks(log(6), 3)
    assert blocks.label.tolist() == ["0[0]", "0[1]", "0[2]"] and blocks.trajectory.tolist() == [0, 0, 1, 1, 2, 2]


def test_stated_tests_are_labels_or_shares_that_leave_something():
    assert stated_test(log(20), "a, b")[1] == ["a", "b"] and stated_test(log(20), None)[1] is None
    for text, words in (
        *((f"last:{share}", "expected a percentage of 1 to 90") for share in ("0%", "95%", "30", "x%", ".%")),
        ("last:2%", "'0' has 20 samples, too few for 10 block.s. and its last 2%"),
    ):
        with one_line(words):
            stated_test(log(20), text)
    with one_line("has 5 samples"):
        stated_test(log(5), "blocks")
