"""The loop does to measurements and controls what the hardware says, and hides no failure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import (
    Controller,
    Gains,
    Hardware,
    Push,
    Reference,
    feed_forward,
    field_of,
    following,
    simulate,
    stateless,
    with_differences,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import pendulum
from dln_jax.types import InputError

FIELD = lambda x, u: jnp.concatenate([x[1:], u])  # noqa: E731  a mass of 1 kg
SETTINGS = {"seconds": 0.2, "rate": 100.0, "controls": 1}
COUNTING = Controller(jnp.zeros(()), lambda number, t, y: (number + 1, number[None] + 1))


def test_controls_are_held_and_integrated_exactly():
    run = simulate(FIELD, COUNTING, [0.0, 0.0], **SETTINGS)
    np.testing.assert_allclose(run.u[:, 0], np.arange(1, 21))
    np.testing.assert_allclose(run.x[1:, 1], 0.01 * np.cumsum(np.arange(1, 21)), rtol=1e-12)
    np.testing.assert_allclose(run.t, 0.01 * np.arange(21))


def test_a_push_adds_to_the_rates_once():
    still = stateless(lambda x: jnp.zeros(1))
    run = simulate(FIELD, still, [0.0, 0.5], push=Push(0.1, [2.0]), **SETTINGS)
    np.testing.assert_allclose(run.x[:, 1], np.where(run.t <= 0.1 + 1e-9, 0.5, 2.5))
    np.testing.assert_allclose(run.x[-1, 0], 0.1 * 0.5 + 0.1 * 2.5)
    np.testing.assert_array_equal(run.y[9:11, 1], [0.5, 2.5])  # it is measured at its own sample


def test_limits_and_delay():
    run = simulate(FIELD, COUNTING, [0.0, 0.0], hardware=Hardware(upper=5.0, delay=3), **SETTINGS)
    np.testing.assert_array_equal(run.u[:, 0], np.minimum(np.maximum(np.arange(20) - 2, 0), 5))


def test_encoders_round_and_rates_come_from_differences():
    seen = with_differences(lambda x: x[1:], 1, rate=100.0, cutoff=1e6)
    lab = Hardware(encoder_step=1e-3, sees_rates=False)
    coasting = simulate(lambda x, u: jnp.array([x[1], 0.0]), seen, [0.0, 0.37], hardware=lab, **SETTINGS)
    assert coasting.y.shape == (20, 1)
    np.testing.assert_allclose(coasting.y / 1e-3, np.round(coasting.y / 1e-3), atol=1e-9)
    assert coasting.u[0, 0] == 0 and np.abs(coasting.u[1:, 0] - 0.37).max() <= 0.1 + 1e-9


def test_noise_has_its_size_and_its_seed():
    lab = Hardware(encoder_noise=0.1, control_noise=0.5)
    still = stateless(lambda y: jnp.zeros(1))
    run = lambda seed: simulate(  # noqa: E731
        lambda x, u: jnp.zeros(2),
        still,
        [0.0, 0.0],
        hardware=lab,
        key=jax.random.key(seed),
        seconds=40.0,
        rate=100.0,
        controls=1,
    )
    first = run(0)
    assert first.y[:, 0].std() == pytest.approx(0.1, rel=0.05) and first.u.std() == pytest.approx(0.5, rel=0.05)
    np.testing.assert_array_equal(first.u, run(0).u)
    assert not np.array_equal(first.u, run(1).u)
    with pytest.raises(InputError, match="give a key"):
        simulate(FIELD, still, [0.0, 0.0], hardware=lab, **SETTINGS)


def test_a_failure_stays_one():
    broken = Controller(jnp.zeros(()), lambda n, t, y: (n + 1, jnp.where(n == 5, jnp.nan, 0.0)[None]))
    run = simulate(FIELD, broken, [0.0, 0.0], hardware=Hardware(-1.0, 1.0), **SETTINGS)
    assert np.isfinite(run.x[:6]).all() and not np.isfinite(run.x[6:]).any()


def test_many_runs_are_one_program():
    law = stateless(lambda y: -4 * y[:1] - 2 * y[1:])
    starts = np.random.default_rng(0).normal(size=(3, 2))
    together = jax.jit(jax.vmap(lambda x: simulate(FIELD, law, x, **SETTINGS).x))(starts)
    np.testing.assert_allclose(together[2], simulate(FIELD, law, starts[2], **SETTINGS).x, rtol=1e-12)


@pytest.mark.parametrize(
    ("settings", "message"), [({"rate": 0.0}, "rate is 0.0"), ({"hardware": Hardware(delay=-1)}, "delay is -1")]
)
def test_settings_out_of_range_are_one_line(settings, message):
    with pytest.raises(InputError, match=message):
        simulate(FIELD, COUNTING, [0.0, 0.0], **{**SETTINGS, **settings})


def test_a_reference_of_held_accelerations_is_followed_exactly():
    samples = 20
    qdd = np.linspace(-1.0, 2.0, samples)[:, None]
    qd = 0.01 * np.concatenate([np.zeros((1, 1)), np.cumsum(qdd, axis=0)[:-1]])
    q = np.concatenate([np.zeros((1, 1)), np.cumsum(0.01 * qd + 0.5e-4 * qdd, axis=0)[:-1]])
    law = lambda q, qd, wanted: wanted.qdd  # noqa: E731  the mass of 1 kg
    run = simulate(FIELD, following(law, Reference(q, qd, qdd), rate=100.0), [0.0, 0.0], **SETTINGS)
    np.testing.assert_allclose(run.x[:-1], np.hstack([q, qd]), atol=1e-14)


def test_feed_forward_of_the_exact_model_errs_by_the_hold_alone():
    """Torques held for a period lag by half of it: with the exact model the error is of first order in the period."""
    plant = dynamics(pendulum().closed_form)
    law, errors = feed_forward(plant, Gains(np.zeros(1), np.zeros(1))), []
    for rate in (100.0, 200.0, 400.0):
        t = np.arange(round(0.5 * rate) + 1)[:, None] / rate
        wanted = Reference(np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t))
        run = simulate(
            field_of(plant), following(law, wanted, rate=rate), [0.0, 3.0], seconds=0.5, rate=rate, controls=1
        )
        errors.append(np.abs(np.asarray(run.x[:, 0]) - wanted.q[:, 0]).max())
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.05)
