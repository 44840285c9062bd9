"""Creatures and values on four devices, and in two processes: what one device alone comes to."""

from pathlib import Path

import numpy as np
import pytest
from sharing import run_on_all

pytestmark = pytest.mark.slow
"""Every program is compiled for one device and for several."""

PATH = Path(__file__).parent / "shared_batches.py"


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The arrays of each run by name; four devices come first, whose run all others continue."""
    folder = tmp_path_factory.mktemp("shared")
    run_on_all(PATH, folder)
    return {path.stem: dict(np.load(path)) for path in folder.glob("*.npz")}


def test_each_ran_on_its_devices(results):
    assert {name: int(outcome["devices"]) for name, outcome in results.items()} == {
        "four devices": 4,
        "one device": 1,
        "first of two": 2,
        "second of two": 2,
    }


@pytest.mark.parametrize(
    ("name", "subject"),
    [
        *(("four devices", subject) for subject in ("gradient", "stiffness", "value", "equation")),
        *((name, of) for name in ("first of two", "second of two") for of in ("stiffness", "value")),
    ],
)
def test_results_are_those_of_one_device(results, name, subject):
    expected, outcome = results["one device"], results[name]
    keys = [key for key in expected if key.startswith(subject)]
    assert keys and keys == [key for key in outcome if key.startswith(subject)]
    for key in keys:
        assert np.isfinite(expected[key]).all()
        np.testing.assert_allclose(outcome[key], expected[key], rtol=1e-12, atol=1e-12, err_msg=key)
