"""Experiments on letters: time scaling, few letters, and learning in the control loop."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import refused

from dln_jax.control import Gains, feed_forward
from dln_jax.control.tracking import feedback
from dln_jax.learning.online import make_linear_refit
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.types import InputError
from scripts.reports.arm import few_letters, learning_online
from scripts.reports.arm.learning_online import CONDITIONS, Condition, closed_loop, write, written_by
from scripts.reports.arm.motions import drawn_letters, reference
from scripts.reports.arm.rivals import Rival
from scripts.reports.commands import delan_report

EXACT = feed_forward(dynamics(two_link_arm().closed_form), learning_online.GAINS)


@pytest.fixture(scope="module")
def letters():
    return generators.characters(letters="lrs", dt=0.04)


@pytest.fixture(scope="module")
def identified():
    model = make_planar_chain(two_link_arm().needs._replace(friction=True), symmetric=False)
    torques = jax.jit(lambda p, *x: jax.vmap(dynamics(model.energies(p)).inverse_dynamics)(*x))
    return Rival(model, make_linear_refit(model), lambda seed: model.init(jax.random.key(seed)), torques)


def test_dynamic_torque_grows_with_the_square_of_speed(letters):
    """Hollerbach (1984): without friction, what a motion takes beyond its weight scales with the square of speed."""
    for speed in (0.5, 2.0):
        fast = few_letters.faster(letters, speed)
        expected = letters.tau_gravity + speed**2 * (letters.tau - letters.tau_gravity)
        np.testing.assert_allclose(fast.tau, expected, atol=1e-12)


def test_references_at_another_speed_are_the_same_path(letters):
    letter = few_letters.select(letters, [0])
    slow, fast = (reference(letter, speed) for speed in (1.0, 2.0))
    for power, (one, other) in enumerate(zip(slow, fast, strict=True)):
        np.testing.assert_allclose(other, 2.0**power * one[::2][: len(other)], atol=1e-10)


def test_one_letter_identifies_the_arm_at_every_speed(letters, identified):
    fit = few_letters.fitted(identified, letters, ["s"], 1, 0)
    at = {speed: few_letters.faster(few_letters.select(letters, [2]), speed) for speed in few_letters.SPEEDS}
    assert max(few_letters.torque_mse(identified, fit.parameters, data) for data in at.values()) < 1e-20
    assert few_letters.share_out_of_distribution(fit, at[2.0]) > 0.5


def test_torques_of_another_arm_are_refused(letters):
    with pytest.raises(InputError, match="tau is not that of the published two-link arm"):
        few_letters.at_speeds("mine", letters._replace(tau=1.1 * letters.tau), ["s"])


def test_splits_have_the_given_test_letters_first_and_none_twice(letters):
    data = generators.characters(dt=0.2)
    first, *others = few_letters.test_sets(data, ["e", "q", "v"], 4)
    assert first == ["e", "q", "v"] and list(map(len, others)) == [3, 3, 3]
    assert len({letter for part in others for letter in part}) == sum(map(len, others))


@pytest.mark.slow
def test_an_arm_that_identifies_itself_writes_its_second_letter_as_the_exact_model_does(letters, identified):
    under = Condition()
    motions = drawn_letters(letters, 2, 0, 1.0)
    exact = partial(write, closed_loop(lambda _, gains: EXACT, under), under)
    by_model = lambda p, gains: feed_forward(dynamics(identified.model.energies(p)), gains)  # noqa: E731
    learned = written_by(partial(write, closed_loop(by_model, under), under), identified, motions, 0, 400)
    known = written_by(exact, None, motions, 0, 400)
    assert learned[0].joint_error > 100 * known[0].joint_error
    np.testing.assert_allclose(learned[1].joint_error, known[1].joint_error, rtol=1e-6)
    assert known[0].joint_error < 2e-4 and known[0].saturated == 0


def test_a_letter_that_is_lost_is_said_and_not_averaged(letters):
    under = Condition(gains=0.0)
    falling = partial(write, closed_loop(lambda _, gains: partial(feedback, gains), under), under)
    runs = [written_by(falling, None, drawn_letters(letters, 2, 0, 1.0), 0, 400)]
    assert all(np.isinf(each.joint_error) and np.isinf(each.tip_error) for each in runs[0])
    rows = {row.quantity: row.value for row in learning_online.rows_of("falling", runs)}
    assert rows["lost_letters"] == rows["letters"] == 2 and np.isinf(rows["first_tip_error_median"])


def test_noisy_encoders_give_recordings_behind_a_filter(letters):
    under = CONDITIONS["noisy-encoders"]
    motion = drawn_letters(letters, 1, 0, 1.0)[0]
    loop = closed_loop(lambda _, gains: EXACT, under)
    outcome, (q, qd, qdd, tau) = write(loop, under, (), motion)
    assert outcome.joint_error < 0.02 and len(q) < motion.samples / 40
    exact = jax.jit(jax.vmap(dynamics(two_link_arm().closed_form).inverse_dynamics))(*map(jnp.asarray, (q, qd, qdd)))
    assert 1e-3 < np.sqrt(np.mean((np.asarray(exact) - tau) ** 2)) < 3


def test_gains_of_a_condition_keep_the_damping_ratio(letters):
    seen = []
    closed_loop(lambda _, gains: seen.append(gains) or partial(feedback, gains), Condition(gains=0.25))(
        (), drawn_letters(letters, 1, 0, 1.0)[0].reference, jax.random.key(0)
    )
    full: Gains = learning_online.GAINS
    np.testing.assert_allclose(seen[0].proportional, 0.25 * full.proportional)
    np.testing.assert_allclose(seen[0].derivative, 0.5 * full.derivative)


def test_unknown_subjects_are_one_line(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "'dance' is unknown; choose from" in refused(capsys, delan_report, "--only", "dance", "--out", "run")
    assert not (tmp_path / "run").exists()
