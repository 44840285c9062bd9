"""Compensated friction does no work at rest, is friction's own away from it, and makes errors of tracking smaller."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import Gains, Reference, feed_forward, field_of, simulate
from dln_jax.control.closed_loop import Controller
from dln_jax.control.desktop_plants import desktop_cart_pole
from dln_jax.control.tracking import friction_compensation, without_friction
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionCoefficients
from dln_jax.scenes.pendulums import pendulum
from dln_jax.scenes.scene import with_friction
from dln_jax.types import InputError

SCENE = desktop_cart_pole().scene
PLANT = dynamics(SCENE.closed_form)
FRICTION = jax.jit(PLANT.friction)


def test_it_does_no_work_at_rest_and_is_friction_s_share_away_from_it():
    forces = jax.jit(friction_compensation(PLANT, [0], smoothing=0.05, gain=0.9))
    q = jnp.array([0.1, 2.0])
    assert float(jnp.abs(forces(q, jnp.array([0.0, 3.0]))[0])) < 1e-15
    for rate in (-2.0, 2.0):
        qd = jnp.array([rate, 3.0])
        assert float(forces(q, qd)[0]) == pytest.approx(0.9 * float(FRICTION(q, qd)[0]), rel=1e-3)
    # Never more than what friction takes, so that no joint is driven by it.
    rates = np.linspace(-0.3, 0.3, 61)
    given = np.array([forces(q, jnp.array([rate, 0.0]))[0] for rate in rates])
    taken = np.array([FRICTION(q, jnp.array([rate, 0.0]))[0] for rate in rates])
    assert (given * rates <= taken * rates + 1e-12).all()


def test_what_is_left_without_friction_is_the_frictionless_plant():
    nominal = desktop_cart_pole()
    bare = dynamics(nominal.nominal(**nominal.sizes).closed_form)
    state = jnp.array([0.1, 2.0]), jnp.array([0.4, -3.0]), jnp.array([0.5, 0.2])
    left = without_friction(PLANT)
    np.testing.assert_allclose(jax.jit(left.inverse_dynamics)(*state), bare.inverse_dynamics(*state), rtol=1e-10)
    np.testing.assert_allclose(jax.jit(left.forward_dynamics)(*state), bare.forward_dynamics(*state), rtol=1e-10)


def test_it_makes_errors_of_tracking_smaller():
    plant = dynamics(with_friction(pendulum(), FrictionCoefficients(coulomb=0.5)).energies)
    track = feed_forward(without_friction(plant), Gains(20.0, 4.0))
    made_up = friction_compensation(plant, [0], smoothing=0.1)

    def wanted(t):
        return Reference(
            *(jnp.sin(2 * t + phase)[None] * 2**order for order, phase in enumerate(np.pi / 2 * np.arange(3)))
        )

    def worst(compensated):
        def act(memory, t, y):
            q, qd = jnp.split(y, 2)
            goal = wanted(t)
            tau = track(q, qd, goal)
            return memory, tau + made_up(q, goal.qd) if compensated else tau

        run = simulate(
            field_of(plant), Controller((), act), [0.0, 2.0], seconds=3.0, rate=200.0, controls=1, substeps=2
        )
        return float(jnp.max(jnp.abs(run.x[200:, 0] - jnp.sin(2 * run.t[200:]))))

    assert worst(True) < 0.5 * worst(False)


@pytest.mark.parametrize(
    ("settings", "message"), [({"smoothing": 0.0}, "smoothing is 0"), ({"smoothing": 0.1, "gain": 1.2}, "gain is 1.2")]
)
def test_settings_out_of_range_are_one_line(settings, message):
    with pytest.raises(InputError, match=message):
        friction_compensation(PLANT, [0], **settings)
