"""Problems and plants of the reports of control: their mechanics by another way, and rivals with the same equations."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dln_jax import dynamics
from dln_jax.control.optimal.problem import rates
from dln_jax.control.state_space import field_of
from dln_jax.scenes.pendulums import cart_pole
from scripts.reports.control import plants, problems, published, values


def test_cart_pole_is_that_of_the_scenes():
    scene = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
    x, u = jnp.array([0.1, 2.0, 0.5, -3.0]), jnp.array([2.0])
    expected = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))(x, u)
    free = problems.cart_pole_rates(problems.Sizes(damping=(0.0, 0.0)))(jnp, x, u)
    assert_allclose(jnp.stack(free), expected, rtol=1e-10)


def test_casadi_has_the_same_formulas():
    import casadi as ca

    random = np.random.default_rng(0)
    for problem in problems.problems():
        x, u = random.normal(size=len(problem.x0)), random.normal(size=len(problem.limit))
        X, U = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(u))
        rows = [*problem.rates(ca, X, U), problem.cost(ca, X, U), problem.cost(ca, X, None)]
        expected = [*problem.rates(np, x, u), problem.cost(np, x, u), problem.cost(np, x, None)]
        found = np.ravel(ca.Function("f", [X, U], [ca.vertcat(*rows)])(x, u))
        assert_allclose(found, np.array(expected, float), rtol=1e-10, atol=1e-10, err_msg=problem.name)


@pytest.mark.parametrize("name", plants.PLANTS)
def test_plant_starts_near_hanging_and_stays_there(name):
    plant, seen = plants.PLANTS[name](0, 1), []
    plant.reset()
    for _ in range(100):
        seen.append(plant.read())
        plant.act(np.zeros(plant.layout.actuation.shape[1]))
    away = np.abs(np.remainder(np.array(seen) - plant.layout.hanging + np.pi, 2 * np.pi) - np.pi).max()
    assert 1e-4 < away < 0.7  # the deviation of a start is 0.1


def test_late_pendulum_follows_ten_milliseconds_after_and_loses_energy_by_friction_alone():
    driven, idle = plants.LatePendulum(0.0), plants.LatePendulum(0.0)
    driven.write(np.full(1, 0.05))
    for wait, moved in ((0.009, False), (0.004, True)):
        for pendulum in (driven, idle):
            pendulum.sleep(wait)
            pendulum.read()
        assert (driven.v[0] - idle.v[0] > 0.1) == moved
    q, v = [0.3, 2.0], [3.0, -1.0]
    a, b = plants.accelerations(q, v, 0.0)
    sine, cosine = np.sin(q[1]), np.cos(q[1])
    # d/dt of (I1 + I2 sin²) v1²/2 + I3 v2²/2 + C cos v1 v2 + W cos
    power = (2.6e-4 + 1e-4 * sine**2) * v[0] * a + 1.33e-4 * v[1] * b + 1.3e-4 * cosine * (v[0] * b + v[1] * a)
    power += 1e-4 * sine * cosine * v[1] * v[0] ** 2 - 1.3e-4 * sine * v[0] * v[1] ** 2 - 1.52e-2 * sine * v[1]
    lost = 1e-4 * v[0] ** 2 + 1e-3 * np.tanh(v[0] / 0.02) * v[0] + 8e-5 * v[1] ** 2
    assert power == pytest.approx(-lost, rel=1e-9)


def test_worst_disturbance_moves_the_published_pendulum():
    problem, x, u = published.pendulum().problem, jnp.array([0.3, -1.0]), jnp.array([0.8])
    assert_allclose(values.rod(x, u, jnp.ones(2)), rates(problem)(x, u), rtol=1e-12)
