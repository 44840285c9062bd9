"""Multiple shooting against Riccati's recursion, single shooting and finite differences, by implicit steps too."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import TrajectoryProblem, field_of, integrated, shoot, time_varying_lqr
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import GAUSS_LEGENDRE_4, MIDPOINT, RADAU_3
from dln_jax.scenes.poles import cart_pole, flexible_cart_pole
from dln_jax.types import InputError

RANDOM = np.random.default_rng(0)
F, G = np.eye(3) + 0.2 * RANDOM.normal(size=(3, 3)), RANDOM.normal(size=(3, 2))
START = np.array([1.0, -2.0, 0.5])
LINEAR = TrajectoryProblem(
    lambda x, u: jnp.asarray(F) @ x + jnp.asarray(G) @ u, lambda x, u: x @ x + 0.5 * u @ u, lambda x: 2 * x @ x
)
N = 8
DOWN = np.array([0.0, np.pi, 0.0, 0.0])
STEPS, DT = 50, 0.04


def test_a_linear_problem_takes_one_iteration_from_any_guess():
    guess = RANDOM.normal(size=(N + 1, 3)), RANDOM.normal(size=(N, 2))
    solve = jax.jit(lambda x: shoot(LINEAR, x, *guess, iterations=2))
    found = solve(START)
    known = time_varying_lqr(np.tile(F, (N, 1, 1)), np.tile(G, (N, 1, 1)), np.eye(3), 0.5 * np.eye(2), 2 * np.eye(3))
    np.testing.assert_allclose(found.plan.K, -known.K, atol=1e-10)
    assert float(found.plan.cost) == pytest.approx(START @ np.asarray(known.S[0]) @ START, rel=1e-12)
    # The cost to go is xᵀ S x.
    np.testing.assert_allclose(found.multipliers[0], 2 * known.S[1] @ found.plan.x[1], rtol=1e-9)
    assert found.defect < 1e-13
    lost = solve(START * np.nan)
    assert np.isnan(lost.plan.cost) and not lost.converged


@functools.cache
def swing_up():
    scene = cart_pole()
    field = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    off = lambda x: x[0] ** 2 + 2 * (1 - jnp.cos(x[1])) + 0.1 * (x[2] ** 2 + x[3] ** 2)  # noqa: E731
    return TrajectoryProblem(
        integrated(field, DT), lambda x, u: DT * (off(x) + 0.01 * u[0] ** 2), lambda x: 50 * off(x), -10.0, 10.0
    )


@functools.cache
def shooter(exact):
    def found(x, states, u, limit):
        return shoot(swing_up()._replace(lower=-limit, upper=limit), x, states, u, exact=exact, tolerance=1e-10)

    return jax.jit(found)


@functools.cache
def from_a_straight_line():
    return shooter(True)(DOWN, np.linspace(DOWN, 0 * DOWN, STEPS + 1), np.zeros((STEPS, 1)), 10.0)


@pytest.mark.slow
def test_a_guess_that_is_no_motion_comes_to_the_optimum_of_single_shooting():
    found = from_a_straight_line()
    assert found.converged and found.defect < 1e-8 and np.abs(found.plan.u).max() <= 10.0
    assert (np.abs(found.plan.u) > 9.999).any() and np.cos(found.plan.x[-1, 1]) > 0.999


@pytest.mark.slow
def test_gains_are_derivatives_of_the_optimum_and_convergence_is_quadratic():
    limit = 1e3  # where none is reached, u is a smooth function of the start
    first = shooter(True)(DOWN, from_a_straight_line().plan.x, from_a_straight_line().plan.u, limit)
    exact = shooter(True)(DOWN, first.plan.x + 1e-2, first.plan.u, limit)
    assert exact.converged and exact.iterations <= 15
    assert float(exact.plan.cost) == pytest.approx(float(first.plan.cost), rel=1e-9)
    step, slopes = 1e-3, []
    for axis in step * np.eye(4):
        ahead, behind = (shooter(True)(DOWN + way, *exact.plan[1::-1], limit).plan.u[0] for way in (axis, -axis))
        slopes.append((ahead - behind) / (2 * step))
    np.testing.assert_allclose(exact.plan.K[0], np.stack(slopes, axis=1), rtol=1e-3)


def test_implicit_steps_have_the_derivatives_of_finite_differences():
    scene = flexible_cart_pole(stiffness=2e5)  # an example of the documentation plans through it
    field = field_of(dynamics(scene.closed_form), np.asarray(scene.needs.actuation))
    stiff = integrated(field, 0.02, method=MIDPOINT)
    step = jax.jit(stiff)
    x, u = 0.01 * jnp.arange(1.0, 7.0).at[1].set(1e-4), jnp.array([2.0])
    slopes = jax.jit(jax.jacfwd(stiff, argnums=(0, 1)))(x, u)
    for slope, by, size in ((slopes[0], lambda e: step(x + e, u), 6), (slopes[1], lambda e: step(x, u + e), 1)):
        numeric = np.stack([(by(1e-6 * each) - by(-1e-6 * each)) / 2e-6 for each in np.eye(size)], axis=1)
        np.testing.assert_allclose(slope, numeric, rtol=1e-5, atol=1e-6)


def test_radau_is_of_order_three_and_forgets_what_decays_fast():
    field = lambda x, u: -u * x  # noqa: E731
    ends = []
    for method, order in ((RADAU_3, 3), (GAUSS_LEGENDRE_4, 4)):
        steps = [integrated(field, 1.0, method=method, substeps=n) for n in (4, 8)]
        errors = [float(abs(step(jnp.ones(1), jnp.ones(1))[0] - np.exp(-1))) for step in steps]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.2)
        ends.append(float(abs(integrated(field, 1.0, method=method)(jnp.ones(1), jnp.full(1, 1e6))[0])))
    assert ends[0] < 1e-5 and ends[1] > 0.99


def test_other_shapes_are_one_line():
    with pytest.raises(InputError, match=r"expected \[n\], \[N\+1, n\] and \[N, m\]"):
        shoot(LINEAR, START, np.zeros((N, 3)), np.zeros((N, 2)))
