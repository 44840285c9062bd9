"""Fits of the double pendulum to torques: of a simulated one all find the same numbers, and its velocity scale."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.planar_chain import PlanarChainParameters
from scripts.reports.robots import double_pendulum_fits as fits

TRUE = PlanarChainParameters(
    moments=jnp.array([0.1, 0.03, 0.03]),
    skew=None,
    armature=jnp.array([0.004]),
    weight=jnp.array([3.0, 1.0]),
    sideways=None,
    viscous=jnp.array([0.02, 0.01]),
    coulomb=jnp.array([0.1, 0.05]),
)
SCALE = 0.2


@pytest.fixture(scope="module")
def logs():
    """Three motions of 2 s under the torques that they take."""
    random, t = np.random.default_rng(0), np.arange(200) / fits.RATE
    rate, phase = random.uniform(3, 9, (2, 3, 1, 2))
    q = np.sin(rate * t[:, None] + phase)
    qd, qdd = rate * np.cos(rate * t[:, None] + phase), -(rate**2) * q
    q, qd, qdd = (each.reshape(-1, 2) for each in (q, qd, qdd))
    model = fits.ten_parameters(SCALE)
    tau = jax.jit(jax.vmap(dynamics(model.energies(TRUE)).inverse_dynamics))(q, qd, qdd)
    arrays = {"t": np.tile(t, 3), "q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(tau)}
    data = schema.from_arrays(arrays | {"trajectory": np.repeat(range(3), 200)})
    return fits.Logs(data, data)


@pytest.mark.slow
def test_torques_tell_all_parameters_and_the_velocity_scale(logs):
    assert fits.choose_scale(logs) == SCALE
    low_passed, off = fits.fit_low_passed(logs, SCALE)
    for found in (fits.fit_torques(logs, SCALE), low_passed, fits.fit_stacked(logs, SCALE)):
        for name in ("moments", "armature", "weight", "viscous", "coulomb"):
            np.testing.assert_allclose(getattr(found.parameters, name), getattr(TRUE, name), rtol=1e-8)
    assert max(off) < 1e-9


def test_parts_keep_whole_recordings(logs):
    part = logs.of(index for index in (0, 2))
    assert all(np.unique(each.trajectory).tolist() == [0, 2] and len(each.t) == 400 for each in part)
