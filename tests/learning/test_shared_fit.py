"""Trainings on four devices, and in two processes over a network: what one device alone comes to."""

import json
from pathlib import Path

import numpy as np
import pytest
from sharing import run_on_all

pytestmark = pytest.mark.slow
"""Every program is compiled for one device and for several."""

PATH = Path(__file__).parent / "shared_trainings.py"
SHARED = ("four devices", "first of two", "second of two")
ROUNDING = 1e-12
"""After a few iterations: sums differ in the last digits alone, and later ones amplify that."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Output and arrays of each run. Four devices come first, and all others continue their half trainings."""
    folder = tmp_path_factory.mktemp("shared")
    run_on_all(PATH, folder)
    names = ("one device", *SHARED)
    return {
        name: (json.loads((folder / f"{name}.json").read_text()), dict(np.load(folder / f"{name}.npz")))
        for name in names
    }


@pytest.mark.parametrize("name", SHARED)
def test_results_are_those_of_one_device(runs, name):
    """Trainings, whole and continued by other devices than began them, and predictions; also by clocks that differ."""
    (_, expected), (said, found) = runs["one device"], runs[name]
    assert said["devices"] == (4 if name == "four devices" else 2)
    assert len(expected) > 50 and found.keys() == expected.keys()
    for key in expected:
        assert np.isfinite(expected[key]).all(), key
        np.testing.assert_allclose(found[key], expected[key], rtol=ROUNDING, atol=ROUNDING, err_msg=key)


@pytest.mark.parametrize("training", ["newton", "adam of four seeds"])
def test_a_training_that_others_continue_is_the_unbroken_one(runs, training):
    for _, found in runs.values():
        whole = [key for key in found if key.startswith(f"{training}:")]
        assert whole
        for key in whole:
            other = found[key.replace(":", ", continued:")]
            np.testing.assert_allclose(other, found[key], rtol=ROUNDING, atol=ROUNDING, err_msg=key)


def test_processes_agree_to_the_last_bit(runs):
    (_, first), (_, second) = runs["first of two"], runs["second of two"]
    for key, array in first.items():
        np.testing.assert_array_equal(array, second[key], err_msg=key)


def test_dispatches_after_the_first_of_a_stage_compile_nothing(runs):
    for said, _ in runs.values():
        counts = said["compilations"]
        first, between, *rest = counts.pop("newton")  # its second stage is another program
        assert between > 0 and [first, *rest] == [0, 0, 0] and len(counts) == 3
        assert all(set(each) == {0} for each in counts.values()), counts


def test_what_cannot_be_shared_is_refused_in_a_line(runs):
    assert runs["one device"][0]["refusals"] == []
    for name in SHARED:
        batch, loss = runs[name][0]["refusals"]
        assert batch.startswith("19 samples of a batch cannot be split over") and "give a multiple of" in batch
        assert loss.startswith("the loss is of a whole batch") and "one device" in loss
