"""A stored policy on other ground: what is loaded, how it is judged, and what is refused."""

import json
import shutil

import jax
import numpy as np
import pytest
from calls import assert_refused, command, json_of, one_line

from dln_jax.commands import evaluate_locomotion, train_locomotion
from dln_jax.commands.locomotion import judge, load_policy
from dln_jax.locomotion.gradient import make_policy
from dln_jax.locomotion.learning import Trials, numbers_of
from dln_jax.locomotion.task import make_task
from dln_jax.softbody.mesh.shapes import creature_named
from dln_jax.zoo.parameter_files import save_tree

STEPS = 10


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("policy")
    policy = make_policy(make_task(creature_named("crawler"), clock_period=9.0), width=5)
    variation = {"start": 0.01, "slope": 4.0, "rough": 0.0, "push": 0.0}
    facts = {"name": "locomotion-gradient", "creature": "crawler", "clock_period": 9.0, "variation": variation}
    save_tree(folder, "model", policy.init(jax.random.key(3)), {"model": {**facts, "settings": {"width": 5}}})
    return folder


def trials(distance, steps, ahead):
    return Trials(*map(np.asarray, (distance, steps, ahead)))


def test_a_policy_comes_back_with_its_ground_or_with_other_ground(run):
    task, _, parameters, _ = load_policy(run)
    assert task.variation == (0.01, 4.0, 0.0, 0.0) and task.clock_period == 9.0
    expected = make_policy(task, width=5).init(jax.random.key(3))
    jax.tree.map(np.testing.assert_array_equal, parameters, expected)
    assert load_policy(run, slope=0.0, rough=0.05, push=None)[0].variation == (0.01, 0.0, 0.05, 0.0)


def test_a_policy_is_good_if_it_hardly_falls_and_goes_ahead_everywhere():
    for standing, level in ((100, "good"), (95, "good"), (94, "doubtful"), (50, "doubtful"), (49, "refused")):
        steps = np.where(np.arange(100) < standing, STEPS, 3)
        verdict = judge(trials(np.ones(100), steps, np.zeros(100)), STEPS)
        assert verdict.level == level and f"{standing} of 100 episodes" in verdict.line
    behind = trials(np.where(np.arange(100) < 2, -0.1, 1.0), np.full(100, STEPS), np.zeros(100))
    assert "2 of them end behind" in judge(behind, STEPS).line


def test_uphill_and_downhill_are_counted_apart_and_an_episode_that_fails_to_converge_does_not_stand():
    numbers = numbers_of(trials([4.0, np.nan, 2.0, -1.0], [10, 10, 7, 10], [1.7, 1.7, 1.7, -1.7]), STEPS)
    assert numbers["perturbed_without_fall"] == 2 and numbers["perturbed_without_fall_downhill"] == 1
    assert numbers["perturbed_starts_downhill"] == 3
    assert numbers["perturbed_distance_body_lengths_median_uphill"] == -1


def test_a_policy_of_another_shape_is_not_trained_further(run, capsys, tmp_path):
    rows = {
        "--creature biped --width 5": "has creature crawler, not biped; give --creature crawler",
        "--width 6": "has width 5, not 6; give --width 5",
    }
    assert_refused(capsys, train_locomotion, rows.items(), "--stored", run, out=tmp_path / "out")


def test_the_command_writes_numbers_and_says_its_verdict(run, tmp_path, capsys):
    command(evaluate_locomotion, "--run", run, "--slope 2 --starts 4 --steps 20 --out", tmp_path / "out")
    assert "verdict: " in capsys.readouterr().out
    numbers = json_of(tmp_path / "out/metrics.json")
    assert numbers["perturbed_starts"] == 4 == numbers["perturbed_without_fall"]


def test_mistakes_are_one_line_and_leave_nothing(run, capsys, tmp_path):
    rows = {
        "--slope 90": "slope is 90",
        "--start nan": "start is nan",
        "--starts 0": "starts is 0",
        "--steps -1": "steps is -1",
        "--seed -1": "seed is -1",
        "--run nowhere": "no such file",
    }
    assert_refused(capsys, evaluate_locomotion, rows.items(), "--run", run, out=tmp_path / "out")


def test_damaged_models_are_refused_in_one_line(run, tmp_path):
    shutil.copytree(run, tmp_path, dirs_exist_ok=True)
    stored = json_of(run / "model.json")
    for change, message in {
        '{"name": "structured"}': "expected a policy of train_locomotion",
        '{"creature": "snail"}': "creature 'snail' is unknown",
        '{"settings": {}}': "width",
        '{"settings": {"width": 6}}': r"expected float64 \(6,\)",
        '{"variation": {"wind": 1.0}}': "wind",
        '{"clock_period": "slow"}': "clock_period",
    }.items():
        damaged = {**stored, "model": {**stored["model"], **json.loads(change)}}
        (tmp_path / "model.json").write_text(json.dumps(damaged))
        with one_line(message):
            load_policy(tmp_path)
