"""--model auto end to end: the model that each arm gets, what is printed and stored, and what is refused."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from calls import assert_refused, json_of, refused
from planar_arm import ARM, FRICTION, motions

from dln_jax import InputError, Robot, build, dynamics, joint_dissipation, load, tree_system
from dln_jax.commands import train_delan
from dln_jax.data import schema
from dln_jax.data.robot_files import mjcf
from dln_jax.runs.arguments import arguments_of
from dln_jax.training.dynamics.methods import learned_tree, selection
from dln_jax.training.dynamics.run import prepare

TREE = "--model learned-tree --data rigid.npz"
PLAIN = '{"joints": ["revolute", "revolute"], "joint_friction": ["viscous"]}'


@pytest.fixture(scope="module")
def workplace(folder):
    """A log of the planar arm, its file with other masses, and a kinematic prior of it."""
    schema.save(folder / "rigid.npz", motions(0, noise=0.02, trajectories=8, samples=240))
    rough = ARM._replace(inertias=0.8 * ARM.inertias)
    free = np.tile([-np.inf, np.inf], (2, 1))
    (folder / "arm.xml").write_text(mjcf(Robot(rough, np.zeros(2), np.zeros(2), free, free)))
    (folder / "prior.json").write_text('{"dh_rows": [[0.4, 0, 0.1, 0], [1.2, 0.2, 0.1, 0]], "angle_degrees": 10}')
    return folder


def of_robot():
    """Arguments of a choice with the robot's file."""
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    options = {"data": Path("rigid.npz"), "robot": Path("arm.xml"), "velocity_scale": 0.01}
    return arguments_of(train_delan.Arguments, model="auto", **options)


def test_the_tree_of_a_robot_is_kept_where_it_explains_all_but_the_noise(workplace, capsys):
    typed = of_robot()
    task, training = selection.fit(prepare(typed), typed, workplace, None)
    stored = json_of(workplace / "model_selection.json")
    assert stored["kept"] == task.kind == "rigid-tree" and "are the noise" in stored["ended"]
    assert [candidate["tried"] for candidate in stored["candidates"]].count(True) == 1
    found = dynamics(build(task.description).energies(training.parameters)).inverse_dynamics
    true = dynamics(tree_system(ARM, joint_dissipation(*FRICTION.values()))).inverse_dynamics
    state = (np.array([0.3, -0.5]), np.array([0.7, 0.4]), np.array([1.0, -2.0]))
    np.testing.assert_allclose(found(*state), true(*state), atol=0.05)


def test_finished_candidates_are_stored_and_not_fitted_again(workplace, tmp_path, monkeypatch):
    typed = of_robot()

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(selection, "noise_of", lambda *_: np.full(2, np.nan))  # so that all candidates are tried
    monkeypatch.setattr(selection, "_by_name", interrupted)
    with pytest.raises(KeyboardInterrupt):
        selection.fit(prepare(typed), typed, tmp_path, None)
    kept = load(tmp_path / "candidates/rigid-tree")

    monkeypatch.setattr(selection, "_rigid_tree", interrupted)
    for name in ("_by_name", "_with_network"):
        monkeypatch.setattr(selection, name, lambda *_: "not in this test")
    task, training = selection.fit(prepare(typed), dataclasses.replace(typed, resume=True), tmp_path, None)
    assert task.description == kept.description
    jax.tree.map(np.testing.assert_array_equal, training.parameters, kept.parameters)
    assert json_of(tmp_path / "candidates/trigonometric/candidate.json") == {"reason": "not in this test"}


def test_a_kinematic_prior_and_parents_reach_the_search(workplace, capsys, monkeypatch):
    seen = {}

    def searched(*data, parents, settings, velocity_scale, **others):
        seen.update(parents=tuple(parents), scale=velocity_scale, **settings._asdict())
        raise InputError("seen")

    monkeypatch.setattr(learned_tree, "fit_tree", searched)
    options = "--velocity-scale 0.02 --kinematic-prior prior.json --parents 0,1 --out near --needs"
    assert "seen" in refused(capsys, train_delan, TREE, options, PLAIN)
    assert seen["parents"] == (-1, 0) and seen["scale"] == 0.02
    assert len(seen["kinematic_prior"].frames.rotations) == 2
    assert seen["kinematic_prior"].angle == pytest.approx(np.radians(10))


def test_mistakes_are_one_line(workplace, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    (workplace / "wrong.json").write_text('{"colour": "red"}')
    rows = {
        "--width 4": "--width is an option of networks",
        "--degree 2": "--degree is an option of --model trigonometric",
        "--lock x": "--lock is for joints of --robot",
        "--robot none.urdf": "none.urdf",
        "--model structured-delan --robot arm.xml": "--robot is an option of --model auto",
        "--model structured-delan --parents 0,1": "--parents is an option of --model auto",
        "--velocity-scale -1": "velocity_scale is -1",
        "--model trigonometric --processes 2": "--processes is an option of networks",
    }
    assert_refused(capsys, train_delan, rows.items(), "--model auto --data rigid.npz", out=workplace / "refused")
    rows = [
        ("--parents 0,3", "--parents is '0,3'"),
        ("--kinematic-prior none.json", "none.json: no such file"),
        ("--kinematic-prior wrong.json", "wrong.json: expected"),
        (
            "--velocity-scale 0.1 --needs",
            '{"joints": ["revolute", "revolute"]}',
            "--velocity-scale is for dry friction",
        ),
        ("--needs", PLAIN.replace("viscous", "stribeck"), "a learned tree has no stribeck friction"),
    ]
    assert_refused(capsys, train_delan, rows, TREE, out=workplace / "refused")
