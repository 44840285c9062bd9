"""Creatures and values on four devices, and in two processes: what one device alone comes to."""

from pathlib import Path

import numpy as np
import pytest
from sharing import run_on_all

pytestmark = pytest.mark.slow
"""Every program is compiled for one device and for several."""


def test_results_are_those_of_one_device(tmp_path):
    """Four devices come first, whose run all others continue."""
    run_on_all(Path(__file__).parent / "shared_batches.py", tmp_path)
    results = {path.stem: dict(np.load(path)) for path in tmp_path.glob("*.npz")}
    devices = {name: int(arrays.pop("devices")) for name, arrays in results.items()}
    assert devices == {"four devices": 4, "one device": 1, "first of two": 2, "second of two": 2}
    expected = results.pop("one device")
    assert results["four devices"].keys() == expected.keys()
    for name, arrays in results.items():
        assert {"stiffness 0", "value 0"} <= arrays.keys()
        for key, array in arrays.items():
            assert np.isfinite(array).all()
            np.testing.assert_allclose(array, expected[key], rtol=1e-12, atol=1e-12, err_msg=f"{name}: {key}")
