"""True values in the cases of the equation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.optimal.plants import PLANTS
from dln_jax.control.optimal.problem import rates
from scripts.reports.control.values.equation import THETA, limited_value, moved, rod


def test_a_limit_that_is_far_away_does_not_count():
    assert limited_value(0.01) == pytest.approx(THETA[0] * 0.01**2, rel=1e-4)
    assert limited_value(5.0) > 3 * THETA[0] * 25


def test_the_worst_disturbance_moves_the_published_pendulum():
    problem, x, u = PLANTS["pendulum"]().problem, jnp.array([0.3, -1.0]), jnp.array([0.8])
    of_model, itself = jax.jit(lambda x, u: (rates(problem)(x, u), rod(x, u, jnp.ones(2))))(x, u)
    np.testing.assert_allclose(itself, of_model, rtol=1e-12)
    np.testing.assert_allclose(rates(moved(problem, (1.3, 1.15)))(x, u), rod(x, u, jnp.array([1.3, 1.15])), rtol=1e-12)
