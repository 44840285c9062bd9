"""Fits of a simulated double pendulum to torques find its parameters and velocity scale; errors of held-out blocks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.planar_chain import PlanarChainParameters
from scripts.reports.robots import recordings as fits

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
    model = fits.chain(SCALE)
    tau = jax.jit(jax.vmap(dynamics(model.energies(TRUE)).inverse_dynamics))(q, qd, qdd)
    arrays = {"t": np.tile(t, 3), "q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(tau)}
    data = schema.from_arrays(arrays | {"trajectory": np.repeat(range(3), 200)})
    return data, data


@pytest.mark.slow
def test_torques_tell_all_parameters_and_the_velocity_scale(logs):
    assert fits.best_scale(logs) == SCALE
    model = fits.chain(SCALE)
    for filtered in (False, True):
        equations = fits.equations(model, logs, filtered=filtered)
        found = fits.with_vector(model, fits.solution(equations))
        for name in ("moments", "armature", "weight", "viscous", "coulomb"):
            np.testing.assert_allclose(getattr(found, name), getattr(TRUE, name), rtol=1e-8)


def test_blocks_count_by_the_whole_logs_variance():
    squares = {
        "chosen-friction": [np.full((10, 2), 2.0), np.full((10, 2), 1.0)],
        "with-residual": [np.full((10, 2), 1.0), np.full((10, 2), 1.0)],
        "pinocchio": [np.full((10, 2), 2.0), np.full((10, 2), 2.0)],
    }
    numbers = fits.block_errors(squares, np.array([10.0, 10.0]), "ab")
    expected = {"nmse": 0.15, "nmse_worst_blocks": 0.2, "nmse_a": 0.15, "nmse_b": 0.15, "over_pinocchio": 0.75}
    assert numbers["recorded-arm/chosen-friction"] == pytest.approx(expected)
    assert numbers["recorded-arm/with-residual"]["over_without"] == pytest.approx(2 / 3)
