"""Values against autodiff of their own, zero at the goal, and the equation of the problem they belong to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.optimal.action_costs import limited_atan, quadratic
from dln_jax.control.optimal.problem import (
    ControlProblem,
    checked,
    from_plant,
    hjb_policy,
    hjb_residual,
    optimal_control,
    rates,
)
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.state_space import field_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import pendulum

HIGH = np.array([0.5, np.pi, 5.0, 20.0])
PROBLEM = ControlProblem(
    lambda x: jnp.concatenate([x[2:], jnp.sin(x[1]) * jnp.array([1.0, 2.0]) - 0.1 * x[2:]]),
    lambda x: jnp.stack([0.0, 0.0, 2.0, jnp.cos(x[1])])[:, None],
    lambda x: x @ x, quadratic(0.1), 0.1, -HIGH, HIGH, ("prismatic", "revolute"), np.zeros(4),
)  # fmt: skip
X = jnp.array([0.2, -2.0, 1.0, 3.0])


def test_values_are_zero_at_the_goal_periodic_and_have_the_gradient_of_autodiff():
    for settings in ({"widths": (6, 5), "members": 3}, {"widths": (), "scale": 7.0, "floor": 0.0}):
        network = value_network(PROBLEM, **settings)
        parameters = jax.tree.map(lambda leaf: leaf + 0.1, network.init(jax.random.key(0)))

        @jax.jit
        def known(x, network=network, parameters=parameters):
            value = lambda x: network.value_and_gradient(parameters, x)  # noqa: E731
            return value(x), jax.grad(lambda x: value(x)[0])(x), network.members(parameters, x)

        (value, slope), expected, each = known(X)
        assert value > 0
        assert_allclose(slope, expected, rtol=1e-12, atol=1e-12)
        assert_allclose(np.mean(each[1], axis=0), slope, rtol=1e-12)
        at_goal = known(jnp.zeros(4))[0]
        assert at_goal[0] == 0 and not np.any(at_goal[1])
        assert_allclose(known(X.at[1].add(2 * np.pi))[0][1], slope, rtol=1e-9)


def test_the_law_of_a_value_keeps_its_limits_and_has_no_control_where_the_state_is_not_finite():
    problem = PROBLEM._replace(action_cost=limited_atan(6.0, 4.0))
    network = value_network(problem, widths=(6, 6), members=2, scale=40.0)
    parameters = network.init(jax.random.key(0))
    law = jax.jit(hjb_policy(lambda x: network.value_and_gradient(parameters, x), problem))
    x = HIGH * np.random.default_rng(0).uniform(-1, 1, (50, 4))
    assert 1.0 < np.abs(jax.vmap(law)(x)).max() <= 6
    assert_allclose(law(jnp.zeros(4)), 0, atol=1e-12)
    for bad in np.where(np.eye(4), np.array([np.nan, np.inf, np.nan, -np.inf]), 0.1):
        assert np.isnan(law(bad)).all()


def test_drift_and_actuation_are_those_of_the_plant():
    plant = dynamics(pendulum(friction=0.1).energies)
    B = np.array([[2.0]])
    x = X[1:3]
    u = jnp.array([2.0])
    a, of = from_plant(plant, B)
    ours, theirs = jax.jit(lambda x, u: (a(x) + of(x) @ u, field_of(plant, B)(x, u)))(x, u)
    assert_allclose(ours, theirs, rtol=1e-12)


def test_the_equation_is_the_least_over_controls():
    slope = jnp.array([1.0, -2.0, 0.3, 0.7])
    value = jnp.asarray(3.0)

    def hamiltonian(u):
        now = PROBLEM.state_cost(X) + PROBLEM.action_cost.cost(u)
        return PROBLEM.discount * value - now - rates(PROBLEM)(X, u) @ slope

    u = optimal_control(PROBLEM, X, slope)
    assert hamiltonian(u) == pytest.approx(float(hjb_residual(PROBLEM, X, value, slope)))
    assert_allclose(jax.grad(hamiltonian)(u), 0, atol=1e-12)


def test_problems_and_networks_that_contradict_themselves_are_refused():
    for change, message in (
        ({"goal": np.array([0.0, 0.5, 0.0, 0.0])}, "not an equilibrium"),
        ({"goal": np.array([0.0, 9.0, 0.0, 0.0])}, "outside the box"),
        ({"high": -HIGH}, "the box is from"),
        ({"low": np.zeros(3)}, "have shapes"),
        ({"discount": -1.0}, "discount is -1.0"),
        ({"state_cost": lambda x: 1.0 + x @ x}, "the goal costs 1 per second"),
        ({"joints": ("revolute",) * 5}, "5 joints"),
    ):
        with one_line(message):
            checked(PROBLEM._replace(**change))
    for wrong, message in (({"widths": (0,)}, "width"), ({"members": 0}, "members"), ({"floor": -1.0}, "floor")):
        with one_line(message):
            value_network(PROBLEM, **wrong)
