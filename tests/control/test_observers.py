"""A controller that predicts does, delay or not, what it does without; how late it is it finds out by itself."""

import jax.numpy as jnp
import numpy as np
from calls import one_line
from numpy.testing import assert_allclose

from dln_jax.control.closed_loop import Hardware, simulate, stateless
from dln_jax.control.observers import with_differences, with_prediction

FIELD = lambda x, u: jnp.concatenate([x[1:], u - 0.3 * x[1:]])  # noqa: E731
LAW = stateless(lambda x: jnp.tanh(4.0 - 9.0 * x[:1] - 4.0 * x[1:]))
SETTINGS = {"seconds": 1.0, "rate": 50.0, "controls": 1}


def step(x, u):
    # The exact solution, as the simulation's within its tolerance.
    decay = jnp.exp(-0.3 / 50)
    rate = x[1] * decay + u[0] * (1 - decay) / 0.3
    return jnp.stack([x[0] + (x[1] + u[0] / 50 - rate) / 0.3, rate])


def test_a_loop_that_predicts_is_the_loop_without_delay_that_comes_later():
    predicting = with_prediction(LAW, step, states=2, controls=1, max_delay=5)
    prompt = simulate(FIELD, LAW, np.zeros(2), **SETTINGS)
    for delay in (0, 3):
        late = simulate(FIELD, predicting, np.zeros(2), hardware=Hardware(delay=delay), **SETTINGS)
        assert_allclose(late.x[delay:], prompt.x[: len(prompt.x) - delay], atol=1e-9)
    # Without prediction it is another motion.
    blind = simulate(FIELD, LAW, np.zeros(2), hardware=Hardware(delay=3), **SETTINGS)
    assert np.abs(blind.x[3:] - prompt.x[:-3]).max() > 1e-2


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
