"""Shares of errors within bands are those of a normal variable, and nonsense is refused."""

import numpy as np
import pytest

from dln_jax.metrics.coverage import LEVELS, coverage, half_width
from dln_jax.types import InputError


def test_bands_of_a_normal_variable_hold_what_they_say():
    random = np.random.default_rng(0)
    std = random.uniform(0.5, 2.0, (20_000, 2))
    covered = coverage(std * random.normal(size=std.shape), std)
    np.testing.assert_allclose(covered.shares, np.tile(LEVELS, (2, 1)).T, atol=0.015)
    assert half_width(0.95) == pytest.approx(1.959964, abs=1e-6)


@pytest.mark.parametrize("level", [0.0, 1.0, np.nan])
def test_a_level_is_a_probability(level):
    with pytest.raises(InputError, match="level"):
        coverage(np.zeros((3, 1)), np.ones((3, 1)), levels=(level,))


def test_shapes_agree():
    with pytest.raises(InputError, match="expected the same"):
        coverage(np.zeros((3, 1)), np.ones((3, 2)))
