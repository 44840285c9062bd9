"""Rates by differences are exact for parabolas, and outlast a failed measurement."""

import jax.numpy as jnp
import numpy as np
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.observers import with_differences

SETTINGS = {"seconds": 1.0, "rate": 50.0, "controls": 1}


def test_differences_of_second_order_are_exact_for_parabolas():
    seen = with_differences(lambda x: x[1:], 1, rate=50.0, cutoff=1e6, order=2)
    lab = Hardware(sees_rates=False)
    falling = simulate(lambda x, u: jnp.stack([x[1], jnp.asarray(-9.81)]), seen, [0.0, 1.0], hardware=lab, **SETTINGS)
    assert_allclose(falling.u[2:, 0], falling.x[2:-1, 1], rtol=1e-9)
    with one_line("order is 3"):
        with_differences(lambda x: x, 1, rate=50.0, cutoff=1.0, order=3)


def test_differences_continue_after_a_measurement_that_is_not_finite():
    controller = with_differences(stateless(lambda x: x[1:]), 1, rate=50.0, cutoff=1e6)
    memory = controller.start
    rates = []
    for number, y in enumerate([0.0, 0.02, 0.04, np.nan, 0.08, 0.1]):
        memory, u = controller.act(memory, jnp.asarray(number / 50), jnp.array([y]))
        rates.append(float(u[0]))
    assert_allclose(rates[1:], 1.0)
