"""Plants of the reports of control: the cart-pole is that of the scenes, and loops of the arm have limits and delay."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import field_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole
from scripts.reports.control import arm_loop, real_time, tracking
from scripts.reports.robots.arm import Motion


def test_the_cart_pole_of_the_report_is_that_of_the_scenes():
    scene = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
    x, u = jnp.array([0.1, 2.0, 0.5, -3.0]), jnp.array([2.0])
    expected = field_of(dynamics(scene.energies), np.asarray(scene.needs.actuation))
    free = real_time.rates_of(real_time.Sizes(damping=(0.0, 0.0)))
    np.testing.assert_allclose(jnp.stack(free(jnp, x, u)), expected(x, u), rtol=1e-10)
    drawn = real_time.starts(2000)
    np.testing.assert_allclose(drawn.mean(axis=0), real_time.HANGING, atol=0.02)
    np.testing.assert_allclose(drawn.var(axis=0), [1e-3, 5e-2, 1e-6, 1e-6], rtol=0.15)


def test_a_loop_has_its_limits_its_delay_and_its_failures():
    wanted = Motion(np.tile([[0.1]], (300, 7)), np.zeros((300, 7)), np.zeros((300, 7)))
    asked = []

    def plant(motion):
        x = np.zeros(14)

        def step(tau):
            asked.append(tau)
            x[7:] += tau / 10 / 1000
            x[:7] += x[7:] / 1000
            return x[:7].copy()

        return x[:7].copy(), step

    def law(q, qd, now):
        return 2000.0 * (now.q - q) - 200.0 * qd

    found = arm_loop.track(plant, law, wanted)
    assert (asked[0] == np.minimum(200.0, arm_loop.LIMITS)).all() and (asked[1] == asked[0]).all()
    assert 10 < found.rms < 100 and found.trusted == 1
    failing = arm_loop.track(plant, lambda q, qd, now: jnp.full(7, jnp.nan), wanted)
    assert np.isnan(failing.rms)
    rows = {row.quantity: row.value for row in tracking.rows_of("any", [found, failing])}
    assert rows["failures"] == 1 and rows["rms_mrad_worst"] == pytest.approx(found.rms)
