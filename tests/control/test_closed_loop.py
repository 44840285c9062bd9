"""The loop does to measurements and controls what the hardware says, and hides no failure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.closed_loop import Controller, Hardware, Push, following, simulate, stateless
from dln_jax.control.state_space import field_of
from dln_jax.control.tracking import Gains, Reference, feed_forward
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import pendulum

FIELD = lambda x, u: jnp.concatenate([x[1:], u])  # noqa: E731  a mass of 1 kg
COUNTING = Controller(jnp.zeros(()), lambda number, t, y: (number + 1, number[None] + 1))
STILL = stateless(lambda y: jnp.zeros(1))


def simulated(controller, start=(0.0, 0.0), field=FIELD, **settings):
    return simulate(field, controller, start, **{"seconds": 0.2, "rate": 100.0, "controls": 1, **settings})


def test_controls_are_held_and_integrated_exactly():
    run = simulated(COUNTING)
    assert_allclose(run.u[:, 0], np.arange(1, 21))
    assert_allclose(run.x[1:, 1], 0.01 * np.cumsum(np.arange(1, 21)), rtol=1e-12)
    assert_allclose(run.t, 0.01 * np.arange(21))


def test_a_push_adds_to_the_rates_once():
    run = simulated(STILL, [0.0, 0.5], push=Push(0.1, [2.0]))
    assert_allclose(run.x[:, 1], np.where(run.t <= 0.1 + 1e-9, 0.5, 2.5))
    assert_allclose(run.x[-1, 0], 0.1 * 0.5 + 0.1 * 2.5)
    assert_array_equal(run.y[9:11, 1], [0.5, 2.5])  # it is measured at its own sample


def test_controls_are_limited_and_delayed():
    run = simulated(COUNTING, hardware=Hardware(upper=5.0, delay=3))
    assert_array_equal(run.u[:, 0], np.clip(np.arange(20) - 2, 0, 5))


def test_noise_has_its_size_and_its_seed():
    lab = Hardware(encoder_noise=0.1, control_noise=0.5)
    first, again, other = (
        simulated(STILL, field=lambda x, u: jnp.zeros(2), hardware=lab, key=jax.random.key(seed), seconds=40.0)
        for seed in (0, 0, 1)
    )
    assert first.y[:, 0].std() == pytest.approx(0.1, rel=0.05) and first.u.std() == pytest.approx(0.5, rel=0.05)
    assert_array_equal(first.u, again.u)
    assert not np.array_equal(first.u, other.u)


def test_settings_out_of_range_are_refused():
    for settings, message in (
        ({"rate": 0.0}, "rate is 0.0"),
        ({"hardware": Hardware(delay=-1)}, "delay is -1"),
        ({"hardware": Hardware(encoder_noise=0.1)}, "give a jax.random key"),
    ):
        with one_line(message):
            simulated(COUNTING, **settings)


def test_a_failure_lasts_until_the_end():
    broken = Controller(jnp.zeros(()), lambda n, t, y: (n + 1, jnp.where(n == 5, jnp.nan, 0.0)[None]))
    run = simulated(broken, hardware=Hardware(-1.0, 1.0))
    assert np.isfinite(run.x[:6]).all() and not np.isfinite(run.x[6:]).any() and np.isnan(run.u[5:]).all()


def test_feed_forward_of_the_exact_model_errs_by_the_hold_alone():
    """Torques held for a period lag by half of it: with the exact model the error is of first order in the period."""
    plant = dynamics(pendulum().closed_form)
    law = feed_forward(plant, Gains(np.zeros(1), np.zeros(1)))
    errors = []
    for rate in (100.0, 200.0, 400.0):
        t = np.arange(round(0.5 * rate) + 1)[:, None] / rate
        wanted = Reference(np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t))
        run = simulated(following(law, wanted, rate=rate), [0.0, 3.0], field_of(plant), seconds=0.5, rate=rate)
        errors.append(np.abs(np.asarray(run.x[:, 0]) - wanted.q[:, 0]).max())
    assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.05)
