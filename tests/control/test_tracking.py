"""Trackers of an exact model obey the linear equation of their gains; one that does not know falls back."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from dln_jax.control.tracking import (
    Gains,
    Reference,
    computed_torque,
    feed_forward,
    gravity_compensation,
    judged,
    trusted,
)
from dln_jax.data.schema import from_arrays
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import rk4, rollout, second_order
from dln_jax.scenes.pendulums import two_link_arm

ARM = dynamics(two_link_arm().energies)
P, D = np.array([36.0, 16.0]), np.array([12.0, 8.0])
Q = jnp.array([0.4, -1.1])
T = jnp.linspace(0, 1, 401)


def reference(t):
    sizes = jnp.array([0.7, -0.4])
    return Reference(sizes * jnp.sin(2 * t), 2 * sizes * jnp.cos(2 * t), -4 * sizes * jnp.sin(2 * t))


def errors(law, off):
    """Errors of the coordinates along the closed loop, from a start that deviates by `off`."""
    field = second_order(lambda t, q, qd: ARM.forward_dynamics(q, qd, law(q, qd, reference(t))))
    start = reference(0.0)
    q, _ = jax.jit(lambda start: rollout(rk4(field), start, T))((start.q + off, start.qd))
    return q - jax.vmap(lambda t: reference(t).q)(T)


def test_computed_torque_makes_errors_decay_linearly_and_feed_forward_stays_on_the_reference():
    # Both joints are critically damped: e = (1 + w t) exp(-w t) e0.
    off = np.array([0.3, -0.2])
    w = np.sqrt(P)
    expected = off * (1 + w * T[:, None]) * np.exp(-w * T[:, None])
    assert_allclose(errors(computed_torque(ARM, Gains(P, D)), off), expected, atol=1e-8)
    assert np.abs(errors(feed_forward(ARM, Gains(np.diag(P), np.diag(D))), 0.0)).max() < 1e-8


def test_gravity_is_held_at_rest():
    rest = jnp.zeros(2)
    tau = gravity_compensation(ARM, Gains(P, D))(Q, rest, Reference(Q, rest, rest))
    assert_allclose(ARM.forward_dynamics(Q, rest, tau), 0.0, atol=1e-12)


def test_an_indefinite_or_unknown_state_falls_back():
    bad = ARM._replace(mass_matrix=lambda q, qd=None: -jnp.eye(2))
    wanted = reference(0.3)
    first, other = computed_torque(ARM, Gains(P, D)), feed_forward(ARM, Gains(P, D))
    for plant, outside, expected in ((ARM, False, first), (ARM, True, other), (bad, False, other)):
        unknown = lambda q, qd, qdd, flag=outside: jnp.asarray(flag)  # noqa: E731
        tau, usable = jax.jit(trusted(plant, first, other, out_of_distribution=unknown))(Q, wanted.qd, wanted)
        assert_allclose(tau, expected(Q, wanted.qd, wanted), rtol=1e-12)
        assert bool(usable) == (expected is first)
    assert not trusted(ARM, first, other, usable=False)(Q, wanted.qd, wanted)[1]


def test_a_model_is_judged_by_motions_that_it_has_not_seen():
    x = np.random.default_rng(0).normal(size=(3, 50, 2))
    tau = np.asarray(jax.jit(jax.vmap(ARM.inverse_dynamics))(*map(jnp.asarray, x)))
    columns = {"q": x[0], "qd": x[1], "qdd": x[2], "tau": tau}
    unseen = from_arrays({"t": 0.01 * np.arange(50), **columns, "trajectory": np.zeros(50, int)})
    good, heavy, lost, hollow = (
        judged(ARM._replace(**changed), unseen)
        for changed in (
            {},
            {"inverse_dynamics": lambda q, qd, qdd: 1.5 * ARM.inverse_dynamics(q, qd, qdd)},
            {"inverse_dynamics": lambda q, qd, qdd: jnp.full(2, jnp.nan)},
            {"mass_matrix": lambda q: -ARM.mass_matrix(q)},
        )
    )
    assert good.usable and np.all(good.nmse < 1e-20) and good.definite == 1 and good.line.endswith("the model is used")
    share = 0.25 * np.mean(tau**2, axis=0) / np.var(tau, axis=0)
    assert_allclose(heavy.nmse, share, rtol=1e-10)
    assert not heavy.usable and f"joint {np.argmax(share) + 1}'s" in heavy.line
    assert not lost.usable
    assert not hollow.usable and "not positive definite in 100.0%" in hollow.line
