"""--model auto end to end: the model that each arm gets, what is printed and stored, and what is refused."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from calls import assert_refused, json_of, refused
from motions import sums_of_sines

from dln_jax import load
from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import train_delan
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial, tree_system
from dln_jax.training.dynamics.methods import learned_tree, selection
from dln_jax.training.dynamics.recorded import read
from dln_jax.training.dynamics.run import prepare
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build

LINK = inertial_parameters(2.0, [0.1, 0.05, 0.2], np.diag([0.03, 0.04, 0.02]))
ROWS = [[0.4, 0, 0.1, 0], [1.2, 0.2, 0.1, 0]]
ARM = serial(*dh_frames(ROWS), [LINK] * 2, armature=np.array([0.1, 0.2]))
RUBBED = tree_system(ARM, joint_dissipation([0.4, 0.2]))
AUTO = "--model auto --data rigid.npz"
TREE = "--model learned-tree --data rigid.npz"
PLAIN = '{"joints": ["revolute", "revolute"], "joint_friction": ["viscous"]}'


def torques(system, states):
    """Returns the torques at states, arrays [N, 2]."""
    return np.asarray(jax.jit(jax.vmap(dynamics(system).inverse_dynamics))(*states))


def motions():
    """Eight noisy motions of the arm with viscous friction."""
    random, T = np.random.default_rng(0), 60
    t, trajectory = np.tile(0.05 * np.arange(T), 8), np.repeat(np.arange(8), T)
    sines = random.uniform([0.2, 1, 0], [0.9, 3, 6], (8, 2, 3, 3)).transpose(3, 0, 1, 2)[:, trajectory]
    states = sums_of_sines(t, *sines)
    tau = torques(RUBBED, states) + 0.02 * random.normal(size=states[0].shape)
    return {"t": t, **dict(zip(("q", "qd", "qdd"), states, strict=True)), "tau": tau, "trajectory": trajectory}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A log of the arm, its file with other masses, and a kinematic prior of it."""
    folder = tmp_path_factory.mktemp("selection")
    np.savez(folder / "rigid.npz", **motions())
    free = np.tile([-np.inf, np.inf], (2, 1))
    rough = ARM._replace(inertias=0.8 * ARM.inertias)
    (folder / "arm.xml").write_text(mjcf(Robot(rough, np.zeros(2), np.zeros(2), free, free)))
    (folder / "prior.json").write_text(json.dumps({"dh_rows": ROWS, "angle_degrees": 10}))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


@pytest.mark.slow
def test_the_tree_of_a_robot_is_kept_where_it_explains_all_but_the_noise(workplace, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    options = {"data": Path("rigid.npz"), "robot": Path("arm.xml"), "velocity_scale": 0.01}
    typed = arguments_of(train_delan.Arguments, model="auto", **options)
    task, training = selection.fit(prepare(typed), typed, workplace, None)
    said, stored = capsys.readouterr().out, json_of(workplace / "model_selection.json")
    assert stored["kept"] == task.kind == "rigid-tree" and "are the noise" in stored["ended"]
    assert "│ rigid-tree " in said and [candidate["tried"] for candidate in stored["candidates"]].count(True) == 1
    found = dynamics(build(task.description).energies(training.parameters))
    state = (np.array([0.3, -0.5]), np.array([0.7, 0.4]), np.array([1.0, -2.0]))
    np.testing.assert_allclose(found.inverse_dynamics(*state), dynamics(RUBBED).inverse_dynamics(*state), atol=0.05)


def test_finished_candidates_are_stored_and_not_fitted_again(workplace, tmp_path, monkeypatch):
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    options = {"data": Path("rigid.npz"), "robot": Path("arm.xml"), "velocity_scale": 0.01}
    typed = arguments_of(train_delan.Arguments, model="auto", **options)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(selection, "noise_of", lambda *_: np.full(2, np.nan))  # so that all candidates are tried
    monkeypatch.setattr(selection, "_by_name", interrupted)
    with pytest.raises(KeyboardInterrupt):
        selection.fit(prepare(typed), typed, tmp_path, None)
    kept = load(tmp_path / "candidates" / "rigid-tree")

    monkeypatch.setattr(selection, "_rigid_tree", interrupted)
    monkeypatch.setattr(selection, "_by_name", lambda *_: "not in this test")
    monkeypatch.setattr(selection, "_with_network", lambda *_: "not in this test")
    task, training = selection.fit(prepare(typed), dataclasses.replace(typed, resume=True), tmp_path, None)
    assert task.kind == "rigid-tree" and task.description == kept.description
    jax.tree.map(np.testing.assert_array_equal, training.parameters, kept.parameters)
    assert json_of(tmp_path / "candidates" / "trigonometric" / "candidate.json") == {"reason": "not in this test"}


def test_a_kinematic_prior_and_parents_reach_the_search(workplace, capsys, monkeypatch):
    seen = {}

    def searched(*data, parents, settings, velocity_scale, **others):
        seen.update(
            parents=tuple(parents),
            kinematic_prior=settings.kinematic_prior,
            angle=settings.prior_angle,
            scale=velocity_scale,
        )
        raise InputError("seen")

    monkeypatch.setattr(learned_tree, "fit_tree", searched)
    options = "--velocity-scale 0.02 --kinematic-prior prior.json --parents 0,1 --out near --needs"
    assert "seen" in refused(capsys, train_delan, TREE, options, PLAIN)
    assert seen["parents"] == (-1, 0) and seen["scale"] == 0.02
    np.testing.assert_allclose(seen["kinematic_prior"].rotations, ARM.rotations, atol=1e-12)
    assert seen["angle"] == pytest.approx(np.radians(10))


def test_one_trajectory_is_cut_into_blocks_of_time(workplace):
    one = {key: values[:60] for key, values in motions().items()}
    np.savez("one.npz", **one)
    recorded = read(arguments_of(train_delan.Arguments, model="auto", data=Path("one.npz")))
    assert [len(np.unique(part.trajectory)) for part in recorded.sets] == [8, 1, 1]
    assert recorded.needs.joint_friction
    assert (
        recorded.lines[-1] == "one recording: cut into blocks of time, 8 for training, 1 for validation, 1 for the test"
    )


def test_mistakes_are_one_line(workplace, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    (workplace / "wrong.json").write_text('{"colour": "red"}')
    frictionless = '{"joints": ["revolute", "revolute"]}'
    rows = [
        (AUTO, "--width 4", "--width is an option of networks"),
        (AUTO, "--degree 2", "--degree is an option of --model trigonometric"),
        (AUTO, "--lock x", "--lock is for joints of --robot"),
        ("--model structured-delan --data rigid.npz --robot arm.xml", "--robot is an option of --model auto"),
        (AUTO, "--robot none.urdf", "none.urdf"),
        (TREE, "--parents 0,3", "--parents is '0,3'"),
        ("--data rigid.npz --width 4 --parents 0,1", "--parents is an option of --model auto"),
        (TREE, "--kinematic-prior none.json", "none.json: no such file"),
        (TREE, "--kinematic-prior wrong.json", "wrong.json: expected"),
        (AUTO, "--velocity-scale -1", "velocity_scale is -1"),
        (TREE, "--velocity-scale 0.1 --needs", frictionless, "--velocity-scale is for dry friction"),
        (TREE, "--needs", PLAIN.replace("viscous", "stribeck"), "a learned tree has no stribeck friction"),
    ]
    assert_refused(capsys, train_delan, rows, out=workplace / "refused")


def test_fits_that_processes_do_not_share_are_refused():
    for model in ("auto", "trigonometric", "trigonometric-kernel", "learned-tree"):
        with pytest.raises(InputError, match="--processes is an option of networks"):
            arguments_of(train_delan.Arguments, model=model, processes=2)
