"""Training, identification and evaluation from Python: what the commands do, in memory."""

import dataclasses

import numpy as np
import optax
import pytest
from calls import one_line
from planar_arm import ARM, FRICTION, motions

import dln_jax
from dln_jax.data.log import log_of
from dln_jax.data.robots import Robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees.recursions import tree_system

STATE = np.array([0.3, -0.5]), np.array([0.7, 0.4]), np.array([1.0, -2.0])
NOISE = 0.02


@pytest.fixture(scope="module")
def log():
    return log_of(motions(0, noise=NOISE, trajectories=6, samples=120), "arm")


@pytest.fixture(scope="module")
def fit(log):
    return dln_jax.train(log, "trigonometric", degree=1)


def test_a_fit_is_judged_and_comes_back_from_its_folder(log, fit, tmp_path):
    assert fit.report.verdict.level == "good"
    fit.save(tmp_path / "mine")
    again = dln_jax.load(tmp_path / "mine")
    np.testing.assert_array_equal(fit.dynamics.inverse_dynamics(*STATE), again.dynamics.inverse_dynamics(*STATE))
    np.testing.assert_array_equal(fit.torque_std(*STATE), again.torque_std(*STATE))
    assert np.all(np.abs(fit.torque_std(*STATE) - NOISE) < 0.5 * NOISE)
    # On another log all of it is the test: the errors are those of the model's torques there.
    other = log_of(motions(1, noise=NOISE, trajectories=2, samples=50), "other")
    torques = [
        again.dynamics.inverse_dynamics(*row) for row in zip(other.data.q, other.data.qd, other.data.qdd, strict=True)
    ]
    report = dln_jax.evaluate(tmp_path / "mine", other)
    expected = np.mean(np.sum((np.array(torques) - other.data.tau) ** 2, axis=1))
    np.testing.assert_allclose(report.metrics["torque_mse"], expected, rtol=1e-9)
    assert report.verdict.level == "good" and "validation_nmse" not in report.metrics


def test_a_robot_is_identified_from_a_wrong_file(log):
    free = np.tile([-np.inf, np.inf], (2, 1))
    rough = Robot(ARM._replace(inertias=0.8 * ARM.inertias), np.zeros(2), np.zeros(2), free, free)
    found = dln_jax.identify(rough, log)
    true = dynamics(tree_system(ARM, joint_dissipation(*FRICTION.values()))).inverse_dynamics
    np.testing.assert_allclose(found.dynamics.inverse_dynamics(*STATE), true(*STATE), atol=3 * NOISE)
    assert found.report.verdict.level == "good" and found.report.metrics["file_nmse"] > 0.01


def test_a_network_is_trained_by_any_optimiser(log):
    words = []
    settings = {"optimizer": optax.adam(3e-3), "steps": 400, "width": 4, "depth": 1, "uncertainty": False}
    fit = dln_jax.train(log, "black-box-delan", seed=1, say=words.append, **settings)
    assert fit.optimiser.rule is settings["optimizer"] and len(fit.training.history) > 1
    assert fit.training.history[-1].validation < fit.training.history[0].validation
    assert any(word.startswith("black-box-delan, f32, adam") for word in words)


def test_mistakes_are_one_line(log):
    for call, words in (
        (lambda: dln_jax.train(log, "resnet"), "model is 'resnet'; expected one of structured-delan"),
        (
            lambda: dln_jax.train(log, "trigonometric", width=3),
            "trigonometric has no setting 'width'",
        ),
        (lambda: dln_jax.train(log, "trigonometric", test="none"), "no trajectory is labelled 'none'"),
        (lambda: dln_jax.make("resnet", log.needs), "this release knows"),
        (lambda: dln_jax.read_log("none.npz"), "none.npz: no such file"),
    ):
        with one_line(words):
            call()


def test_what_holds_arrays_is_shown_in_two_lines(log, fit):
    model = dln_jax.make("structured-delan", log.needs, width=4)
    assert "structured-delan" in dln_jax.model_names()
    for shown, words in (
        (log, "Log of arm: 720 samples of 6 trajectories"),
        (log.data, "Trajectories: 720 samples"),
        (model, "parameters"),
        (fit, "Fit of trigonometric"),
    ):
        assert repr(shown).count("\n") == 1 and words in repr(shown)


def test_a_fit_says_what_it_is_by_its_fields(fit):
    names = {field.name for field in dataclasses.fields(fit)}
    assert {"model", "parameters", "description", "training", "report"} <= names
