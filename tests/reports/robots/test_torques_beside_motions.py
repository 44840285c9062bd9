"""Torques of filtered motions add their squares to the loss of matched motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.learning.engine.problem import Problem, loss_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.types import InputError
from scripts.reports.robots.torques_beside_motions import TorqueWindows, with_torques
from tests.learning.test_measured_motions import CHAIN, TRUE

COUNT, WINDOW = 3, 4


@pytest.mark.slow
def test_torques_beside_motions_add_their_squares():
    q, qd, qdd, tau = np.random.default_rng(0).normal(size=(4, COUNT, WINDOW, 2))
    torques = TorqueWindows(q, qd, qdd, tau, np.ones((COUNT, WINDOW)))
    known = {"noise": (0.5, 0.25), "share": 3.0}
    score = lambda parameters: (jnp.asarray(2.0), jnp.asarray(jnp.nan))  # noqa: E731
    task = Problem(lambda parameters, motion: motion, TRUE, (jnp.full((COUNT, 1), 2.0),), score)
    both = with_torques(task, CHAIN, torques, torques, **known)
    off = jax.jit(jax.vmap(jax.vmap(dynamics(CHAIN.energies(TRUE)).inverse_dynamics)))(q, qd, qdd) - tau
    expected = 3.0 * np.mean(np.sum((np.asarray(off) / np.array([0.5, 0.25])) ** 2, axis=2))
    assert float(jax.jit(loss_of(both))(TRUE, both.arrays)) == pytest.approx(4.0 + expected)
    assert float(both.score(TRUE)[0]) == pytest.approx(2.0 + expected)
    for changed, message in (({"share": 0.0}, "share is 0"), ({"noise": (0.5, -1.0)}, "noise is -1")):
        with pytest.raises(InputError, match=message):
            with_torques(task, CHAIN, torques, torques, **(known | changed))
    fewer = task._replace(arrays=(jnp.zeros((2, 1)),))
    with pytest.raises(InputError, match=f"{COUNT} windows of torques, 2 of motions"):
        with_torques(fewer, CHAIN, torques, torques, **known)
