"""Measured motions of two coupled joints, by the command: momenta of the model, stated tests and noise, the report."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from dln_jax import load
from dln_jax.cli.commands import train_hnn_task
from dln_jax.learning.measured_motions import motion
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.training.hamiltonian.tasks import MEASURED, Stated, problem_of
from dln_jax.types import Needs
from tests.calls import command, json_of, one_line
from tests.standard_errors import SURE

NEEDS = Needs(joints=("revolute", "revolute"), friction=True)
COUNT, LENGTH, NOISE = 4, 64, 1e-3
CHAIN = make_planar_chain(NEEDS, coordinates="absolute")
TRUE = CHAIN.init(jax.random.key(0))._replace(
    moments=jnp.array([2.0, 1.0, 1.0]), weight=jnp.array([19.62, 9.81]), viscous=jnp.array([0.1, 0.05])
)


@pytest.fixture(scope="module")
def double(tmp_path_factory):
    """Angles from the vertical of a double pendulum, and a file of another recording."""
    folder = tmp_path_factory.mktemp("double")
    plant, t, random = dynamics(CHAIN.energies(TRUE)), 0.02 * jnp.arange(LENGTH), np.random.default_rng(0)
    starts = random.uniform(-1.5, 1.5, (COUNT, 4))
    states = np.asarray(jax.jit(jax.vmap(lambda start: motion(plant, start, t, substeps=2)))(starts))
    q = states[..., :2] + NOISE * random.normal(size=states[..., :2].shape)
    arrays = {"t": np.tile(t, COUNT), "q": q.reshape(-1, 2), "trajectory": np.repeat(range(COUNT), LENGTH)}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        np.savez("double.npz", **arrays, label=["a", "b", "c", "d"])
        np.savez("other.npz", **{key: value[:LENGTH] for key, value in arrays.items()})
        yield folder


MEASURE = "--task measured --data double.npz --no-low-latency --no-figures"


@pytest.mark.slow
def test_coupled_joints_are_learned_and_reported(double, capsys):
    options = "--model planar-chain --coordinates absolute --test d --steps 20"
    command(train_hnn_task, MEASURE, options, "--out run")
    assert "here the mean inertia at q = (0, 0) is 1" in capsys.readouterr().out
    metrics = json_of(double / "run" / "metrics.json")
    assert {"vpt_seconds", "vpt_median_seconds", "energy_drift", "rollout_mse", "validation_error"} <= set(metrics)
    # A deviation from N residuals is off by 1 / √(2 N) of it; polynomials take up less than a third of N.
    assert metrics["q1_noise"] == pytest.approx(NOISE, rel=SURE / np.sqrt(2 * 0.7 * 3 * LENGTH))
    assert 0 < metrics["vpt_seconds"] <= metrics["predicted_seconds"] and metrics["energy_drift"] < 1e-3
    run = load(double / "run")
    M = run.dynamics.mass_matrix(np.zeros(2))
    # The gauge can be met exactly, so that a fit that has converged does; what motions tell is off by noise.
    assert np.trace(M) / 2 == pytest.approx(1, abs=1e-6)
    true = np.asarray(ravel_pytree(TRUE)[0]) / 1.5
    # Standard errors are below 5 %.
    np.testing.assert_allclose(ravel_pytree(run.parameters)[0][:5], true[:5], rtol=0.05 * SURE)


def test_tests_and_noise_may_be_stated(double):
    def stated(**options):
        return problem_of(MEASURED, data=double / "double.npz", stated=Stated(**options))

    known = stated(test="b, d", noise=(0.01, 0.02))
    assert known.noise.q == (0.01, 0.02) and known.noise.qd is None
    assert len(known.truth) == 2 and len(known.fitted.t) == 2 * LENGTH
    other = stated(test=str(double / "other.npz"))
    assert len(other.truth) == 1 and len(other.fitted.t) == COUNT * LENGTH
    for options, message in (
        ({"test": "e"}, "labelled 'e'"),
        ({"test": "a,b,c,d"}, "are for the test"),
        ({"noise": (0.1, 0.1, 0.1)}, "noise has 3 numbers"),
    ):
        with one_line(message):
            stated(**options)
