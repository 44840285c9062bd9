"""Quadratic programs over a horizon against the conditions of their optimum, all controls at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.constrained_lq import Horizon, least_cost

N, n, m = 6, 3, 2
RANDOM = np.random.default_rng(0)
ROOTS = RANDOM.normal(size=(N, n + m, n + m))
LIMITS = {"both": (-0.3, 0.4), "one": (-0.2, np.inf), "none": (-np.inf, np.inf)}
SOLVED = jax.jit(least_cost)


def horizon(low, high, definite=1.0):
    return Horizon(
        RANDOM.normal(size=(N, n, n + m)), RANDOM.normal(size=(N, n)), RANDOM.normal(size=(N, n + m)),
        definite * ROOTS @ ROOTS.transpose(0, 2, 1), RANDOM.normal(size=n), definite * np.eye(n),
        np.full((N, m), low), np.full((N, m), high),
    )  # fmt: skip


def cost(given, du):
    dx, total = jnp.zeros(n), 0.0
    for k in range(N):
        both = jnp.concatenate([dx, du[k]])
        total += given.gradients[k] @ both + both @ given.curvatures[k] @ both / 2
        dx = given.slopes[k] @ both + given.missed[k]
    return total + given.end_gradient @ dx + dx @ given.end_curvature @ dx / 2


@pytest.mark.parametrize("limits", LIMITS)
def test_what_is_free_is_stationary_and_what_is_not_pushes_outwards(limits):
    low, high = LIMITS[limits]
    given = horizon(low, high)
    found = SOLVED(given)
    slope, du = np.asarray(jax.jit(jax.grad(cost, argnums=1))(given, found.du)), np.asarray(found.du)
    assert (du >= low).all() and (du <= high).all()
    at_low, at_high = du < low + 1e-6, du > high - 1e-6
    np.testing.assert_allclose(slope[~at_low & ~at_high], 0.0, atol=1e-6)
    assert (slope[at_low] > 0).all() and (slope[at_high] < 0).all()
    assert at_low.any() == (limits != "none")
    np.testing.assert_allclose(found.K[at_low | at_high], 0.0, atol=1e-5)


def test_what_has_no_minimum_has_no_solution():
    assert not np.isfinite(SOLVED(horizon(-np.inf, np.inf, definite=-1.0)).du).all()
