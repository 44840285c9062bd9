"""Trainings on four devices, and in two processes over a network: what one device alone comes to."""

from pathlib import Path

import numpy as np
from calls import json_of
from sharing import run_on_all

ROUNDING = 1e-12
"""After a few iterations: sums differ in the last digits alone, and later ones amplify that."""


def test_results_are_those_of_one_device(tmp_path):
    """Trainings, whole and continued by other devices than began them; also by clocks that differ."""
    run_on_all(Path(__file__).parent / "shared_trainings.py", tmp_path)
    names = ("one device", "four devices", "first of two", "second of two")
    alone, *shared = (dict(np.load(tmp_path / f"{name}.npz")) for name in names)
    said = [json_of(tmp_path / f"{name}.json") for name in names]
    assert [each["devices"] for each in said] == [1, 4, 2, 2] and said[0]["refusal"] == ""
    for each in said[1:]:
        assert each["refusal"].startswith("19 samples of a batch cannot be split over")
    for key, expected in alone.items():
        assert np.isfinite(expected).all(), key
        whole = alone[key.replace(", continued:", ":")]
        np.testing.assert_allclose(expected, whole, rtol=ROUNDING, atol=ROUNDING, err_msg=key)
        for found in shared:
            np.testing.assert_allclose(found[key], expected, rtol=ROUNDING, atol=ROUNDING, err_msg=key)
        np.testing.assert_array_equal(shared[1][key], shared[2][key], err_msg="two processes differ")
