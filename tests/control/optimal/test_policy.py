"""The law of a value: within limits, no number from what is none, in a closed loop, and the same in C."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

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


@pytest.mark.parametrize("x", ([np.nan, 0.0], [0.0, np.nan], [np.inf, 0.0], [0.0, -np.inf]))
def test_no_number_comes_from_what_is_none(x):
    assert np.isnan(LAW(jnp.array(x))).all()


def test_limits_hold_and_the_goal_is_left_alone():
    x = HIGH * np.random.default_rng(0).uniform(-1, 1, (50, 2))
    assert np.abs(jax.vmap(LAW)(x)).max() < 6
    np.testing.assert_allclose(LAW(jnp.zeros(2)), 0, atol=1e-12)


def test_the_closed_loop_in_c_is_that_in_jax(tmp_path):
    field, rate = rates(POLE), 100.0
    run = simulate(field, stateless(LAW), [0.3, 0.0], seconds=0.5, rate=rate, controls=1)
    export_c({"law": (LAW, (np.zeros(2),)), "field": (field, (np.zeros(2), np.zeros(1)))}, tmp_path / "law")
    in_c, x = load_c(tmp_path / "law"), np.array([0.3, 0.0])
    for u in np.asarray(run.u):
        held = np.asarray(in_c.law(x))
        np.testing.assert_allclose(held, u, rtol=1e-10, atol=1e-12)
        stages = [np.asarray(in_c.field(x, held))]
        for share in (0.5, 0.5, 1.0):
            stages.append(np.asarray(in_c.field(x + share * stages[-1] / rate, held)))
        x = x + (stages[0] + 2 * stages[1] + 2 * stages[2] + stages[3]) / (6 * rate)
    np.testing.assert_allclose(x, run.x[-1], rtol=1e-10)
    assert np.isnan(np.asarray(in_c.law(np.array([np.nan, 0.0])))).all()
