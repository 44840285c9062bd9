"""Controllers in C answer as in JAX, model-predictive control too; loops of the arm are as they are said to be."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import Gains, Reference, TrajectoryProblem, feed_forward, field_of, first_plan
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from scripts.reports.control import arm_loop, laws_in_c, real_time, tracking
from scripts.reports.robots.arm import Motion


def planning():
    """A pendulum's plan, moved on and improved."""
    field = lambda x, u: jnp.stack([x[1], jnp.sin(x[0]) + u[0]])  # noqa: E731
    problem = TrajectoryProblem(
        lambda x, u: x + 0.1 * field(x, u), lambda x, u: x @ x + u @ u, lambda x: 9 * x @ x, -0.5, 0.5,
        states=lambda x: x[1:] - 0.3,
    )  # fmt: skip
    return laws_in_c.Law(*real_time.renewed(problem, first_plan(problem, np.zeros(2), np.zeros((3, 1)))), 0.2)


def test_laws_agree(tmp_path):
    follow = feed_forward(dynamics(rotary_pendulum().closed_form), Gains(np.ones(2), np.ones(2)))
    tracker = laws_in_c.Law(lambda q, qd, *wanted: follow(q, qd, Reference(*wanted)), (np.zeros(2),) * 5)
    table = {"plan": planning(), "tracker": tracker}
    export_c({name: (law.function, law.examples) for name, law in table.items()}, tmp_path / "laws")
    in_c = load_c(tmp_path / "laws", flags=("-O0",))
    for name, law in table.items():
        row = laws_in_c.agreement(name, law, in_c)
        assert row.passed and row.value < 1e-12, name


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
