"""The law of a value: within limits, no number from what is none, in a closed loop, and the same in C."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control import simulate, stateless
from dln_jax.control.optimal.action_costs import limited_atan
from dln_jax.control.optimal.problem import ControlProblem, hjb_policy, rates
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c

HIGH = np.array([np.pi, 8.0])
POLE = ControlProblem(
    lambda x: jnp.stack([x[1], 10 * jnp.sin(x[0])]), lambda x: jnp.array([[0.0], [3.0]]),
    lambda x: (1 - jnp.cos(x[0])) + 0.1 * x[1] ** 2, limited_atan(6.0, 8.0), 0.1,
    -HIGH, HIGH, ("revolute",), np.zeros(2),
)  # fmt: skip
NETWORK = value_network(POLE, widths=(6, 6), members=2, scale=40.0)
PARAMETERS = NETWORK.init(jax.random.key(0))
LAW = jax.jit(hjb_policy(lambda x: NETWORK.value_and_gradient(PARAMETERS, x), POLE))


def test_limits_hold_the_goal_is_left_alone_and_no_number_comes_from_what_is_none():
    x = HIGH * np.random.default_rng(0).uniform(-1, 1, (50, 2))
    assert np.abs(jax.vmap(LAW)(x)).max() < 6
    np.testing.assert_allclose(LAW(jnp.zeros(2)), 0, atol=1e-12)
    for bad in ([np.nan, 0.0], [0.0, np.nan], [np.inf, 0.0], [0.0, -np.inf]):
        assert np.isnan(LAW(jnp.array(bad))).all()


def test_closed_loop_in_c_is_that_in_jax(tmp_path):
    field, x = rates(POLE), np.array([0.3, 0.0])
    run = simulate(field, stateless(LAW), x, seconds=0.5, rate=100.0, controls=1)
    export_c({"law": (LAW, (x,)), "field": (field, (x, np.zeros(1)))}, tmp_path)
    in_c = load_c(tmp_path)
    for x, u in zip(np.asarray(run.x), np.asarray(run.u), strict=False):
        np.testing.assert_allclose(in_c.law(x), u, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(in_c.field(x, u), field(x, u), rtol=1e-12)
    assert np.isnan(np.asarray(in_c.law(np.array([np.nan, 0.0])))).all()
