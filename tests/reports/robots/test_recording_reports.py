"""Errors of held-out blocks of a recorded arm."""

import numpy as np
import pytest

from scripts.reports.robots import recordings as fits


def test_blocks_count_by_the_whole_logs_variance():
    squares = {
        "chosen-friction": [np.full((10, 2), 2.0), np.full((10, 2), 1.0)],
        "with-residual": [np.full((10, 2), 1.0), np.full((10, 2), 1.0)],
        "pinocchio": [np.full((10, 2), 2.0), np.full((10, 2), 2.0)],
    }
    numbers = fits.block_errors(squares, np.array([10.0, 10.0]), "ab")
    expected = {"nmse": 0.15, "nmse_worst_blocks": 0.2, "nmse_a": 0.15, "nmse_b": 0.15, "over_pinocchio": 0.75}
    assert numbers["recorded-arm/chosen-friction"] == pytest.approx(expected)
    assert numbers["recorded-arm/with-residual"]["over_without"] == pytest.approx(2 / 3)
