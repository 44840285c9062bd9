"""Held-out motions stated as labels, as the last part of every trajectory, or as blocks of time."""

import numpy as np
import pytest

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import split
from dln_jax.data.stated_tests import stated_test
from dln_jax.training.hamiltonian.measurements import parted
from dln_jax.training.identification.task import held_out
from dln_jax.types import InputError


def data(*counts):
    trajectory = np.repeat(np.arange(len(counts)), counts)
    t = np.concatenate([np.arange(count) / 10 for count in counts])
    q = np.random.default_rng(0).normal(size=(len(t), 1))
    return from_arrays({"t": t, "q": q, "tau": q, "trajectory": trajectory})


def test_the_last_part_of_every_trajectory_is_held_out():
    log = data(100, 50)
    cut, labels = stated_test(log, "last:30%")
    assert labels == ["0[last]", "1[last]"]
    sets = split(cut, test=labels)
    late = np.where(log.trajectory == 0, log.t >= 7, log.t >= 3.5)
    np.testing.assert_array_equal(np.sort(sets.test.q, axis=0), np.sort(log.q[late], axis=0))
    assert len(sets.train.t) + len(sets.validation.t) == np.sum(~late)


def test_one_trajectory_suffices_for_both():
    for text, tested in (("last:20%", 0.2), ("blocks", 0.1)):
        cut, labels = stated_test(data(200), text)
        sets = split(cut, test=labels)
        assert len(sets.test.t) == tested * 200 and len(sets.validation.t) and len(sets.train.t) > 100
        known = held_out(data(200), text, in_parts=False)
        assert len(known.test.t) == {"last:20%": 40, "blocks": 40}[text]
        fitted, test = parted("measured", data(200), "log", text)
        assert len(fitted.t) + len(test.t) == 200 and len(test.t) == tested * 200


def test_labels_are_still_labels():
    assert stated_test(data(20), "a, b")[1] == ["a", "b"] and stated_test(data(20), None)[1] is None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *(
            (text, "expected a percentage of 1 to 90")
            for text in ("last:0%", "last:95%", "last:30", "last:x%", "last:.%")
        ),
        ("last:2%", "'0' has 20 samples, too few for --test last:2%"),
        ("blocks", "has 5 samples"),
    ],
)
def test_shares_that_leave_nothing_are_refused(text, words):
    with pytest.raises(InputError, match=words):
        stated_test(data(5 if text == "blocks" else 20), text)
