"""Controllers in C answer as they do in JAX."""

import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import (
    EnergyGains,
    Gains,
    Reference,
    computed_torque,
    energy_shaping,
    feed_forward,
    field_of,
    linearise,
    lqr,
    parts_of,
    regulated,
    switched,
    value,
)
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import rotary_pendulum


@pytest.mark.slow
def test_laws_are_the_same_in_c(tmp_path):
    scene = rotary_pendulum(friction=1e-5)
    plant, B, joints = dynamics(scene.energies), np.asarray(scene.needs.actuation), scene.needs.joints
    at = linearise(field_of(plant, B), np.zeros(4), np.zeros(1))
    regulator = lqr(at.A, at.B, np.eye(4), np.eye(1))
    swing = energy_shaping(plant, parts_of(B), [0.0, 0.0], EnergyGains(2e7, 20.0, 5.0))
    near, cost = regulated(regulator, at.x, at.u, joints), value(regulator, at.x, joints)
    gains = Gains(np.full(2, 100.0), np.full(2, 20.0))
    follow, lead = computed_torque(plant, gains), feed_forward(plant, gains)
    laws = {
        "regulated": near,
        "swing_up": switched(lambda x: swing(x[:2], x[2:]), near, cost, 0.1),
        "computed_torque": lambda q, qd, *wanted: follow(q, qd, Reference(*wanted)),
        "feed_forward": lambda q, qd, *wanted: lead(q, qd, Reference(*wanted)),
    }
    sizes = {"regulated": (4,), "swing_up": (4,), "computed_torque": (2,) * 5, "feed_forward": (2,) * 5}
    export_c({name: (law, tuple(np.zeros(n) for n in sizes[name])) for name, law in laws.items()}, tmp_path / "laws")
    in_c = load_c(tmp_path / "laws")
    random = np.random.default_rng(0)
    for name, law in laws.items():
        for scale in (0.01, 1.0):
            state = [scale * random.normal(size=n) for n in sizes[name]]
            assert np.asarray(getattr(in_c, name)(*state)) == pytest.approx(
                np.asarray(law(*map(jnp.asarray, state))), rel=1e-12, abs=1e-15
            )
