"""Encoders and late torques give the true plant by the weak form of linear models."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from furuta import HARDWARE, SCENE, TRUTH, simulated_furuta

from dln_jax.control.plants.exploring import Exploration, explore
from dln_jax.data.schema import from_arrays
from dln_jax.learning.momentum import cut_momentum_windows, window_errors
from dln_jax.learning.recordings import driven_torques, identified, identified_chain, prepare


def test_torques_come_late_and_are_held():
    tau = np.arange(1.0, 6.0)[:, None] * np.ones(2)
    few = from_arrays({"t": np.arange(5) / 500, "q": tau, "qd": tau, "qdd": tau, "tau": tau, "trajectory": np.zeros(5)})
    np.testing.assert_allclose(driven_torques(few, delay=0).tau[:, 0], [0.5, 1.5, 2.5, 3.5, 4.5])
    np.testing.assert_allclose(driven_torques(few, delay=2).tau[:, 1], [0, 0, 0.5, 1.5, 2.5])
    np.testing.assert_allclose(driven_torques(few, delay=0.25).tau[:, 0], [0.375, 1.25, 2.25, 3.25, 4.25])


@pytest.fixture(scope="module")
def recording():
    return explore(simulated_furuta(), lambda _: TRUTH, Exploration(seconds=12.0)).recording


@pytest.fixture(scope="module")
def prepared(recording):
    return prepare(recording)


def test_the_delay_is_found_and_the_truth_leaves_noise_alone(prepared):
    assert prepared.delay == HARDWARE.delay
    assert len(np.unique(prepared.train.trajectory)) == 5 and len(np.unique(prepared.validation.trajectory)) == 1
    left = np.asarray(window_errors(TRUTH, cut_momentum_windows(prepared.train)))
    assert (np.sqrt(np.mean(left**2, axis=0)) < 0.02 * prepared.train.tau[:, 0].std()).all()


@pytest.mark.slow
def test_identified_inertias_and_friction_are_the_plant_s(prepared):
    found = identified(prepared.train, SCENE.needs).dynamics
    q, qd = jnp.array([0.0, 0.7]), jnp.array([2.0, 3.0])
    np.testing.assert_allclose(found.mass_matrix(q), TRUTH.mass_matrix(q), rtol=0.03)
    np.testing.assert_allclose(found.friction(q, qd), TRUTH.friction(q, qd), rtol=0.3)


def test_the_inertias_of_an_arm_that_does_not_move_in_a_plane_take_the_higher_degree(prepared):
    found = identified_chain(prepared, SCENE.needs)
    assert found.description["degree"] == [0, 2]
    q = jnp.array([0.0, 0.7])
    np.testing.assert_allclose(found.dynamics.mass_matrix(q), TRUTH.mass_matrix(q), rtol=0.03)


@pytest.mark.slow
def test_a_cut_off_that_takes_the_motion_away_is_not_chosen(recording, prepared):
    chosen = prepare(recording, delay=prepared.delay, chain=True, cutoffs=(0.1, 1.0, 1e4))
    assert chosen.cutoff == prepared.cutoff
    slow = prepare(recording, delay=prepared.delay, cutoffs=(0.1,))
    assert slow.cutoff == pytest.approx(0.1 * prepared.cutoff)


@pytest.mark.slow
def test_mistakes_are_one_line(recording):
    for call, message in [
        (lambda: driven_torques(recording, delay=-0.5), r"delay is -0\.5"),
        (lambda: prepare(recording._replace(needs=None)), "and no needs"),
    ]:
        with one_line(message):
            call()
