"""The command end to end: a URDF and a log become a run folder, a robot's file and C; mistakes are one line."""

import re

import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, one_line
from numpy.testing import assert_allclose, assert_array_equal
from planar_arm import FRICTION, URDF, motions

from dln_jax import load, load_c, read_robot
from dln_jax.commands import identify
from dln_jax.data.log import log_of, split_log
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_run

LOG = "--robot arm.urdf --data log.npz"
QUICK = "--no-figures --no-uncertainty"


@pytest.fixture(scope="module")
def workplace(folder):
    """A robot's file with masses that are too small, and a log of the true one, columns the other way round."""
    (folder / "arm.urdf").write_text(URDF)
    tree = read_robot(folder / "arm.urdf").tree
    tree = tree._replace(inertias=1.5 * tree.inertias, armature=np.array([0.1, 0.2]))
    log = motions(0, noise=0.05, samples=400, tree=tree)
    swapped = {key: getattr(log, key)[:, ::-1] for key in ("q", "qd", "qdd", "tau")}
    np.savez("log.npz", t=log.t, trajectory=log.trajectory, joint_names=["elbow", "shoulder"], **swapped)
    return folder


@pytest.fixture(scope="module")
def identified(workplace):
    command(identify, LOG, "--out run")
    return workplace / "run"


def test_sound_log_gives_a_good_run_folder_like_every_other(identified):
    assert {path.name for path in identified.iterdir()} == {
        *(".lock", "config.json", "metrics.json", "model.json", "model.safetensors", "parameters.json", "report.txt"),
        *("torque.png", "friction.png", "arm_identified.urdf"),
        *("uncertainty.json", "uncertainty.safetensors", "uncertainty.png"),
    }
    metrics, config, stored = (json_of(identified / f"{name}.json") for name in ("metrics", "config", "parameters"))
    assert metrics["nmse"] < 1.1 * metrics["least_squares_nmse"] + 1e-4 < metrics["file_nmse"]
    assert metrics["noise_nmse"] < metrics["nmse"] < 0.05 < metrics["file_nmse"]
    assert metrics["coverage_95_share"] > 0.85 and metrics["noise_joint_1"] == pytest.approx(0.05, rel=0.15)
    assert len(stored["base"]) == metrics["base_parameters"] and len(stored["parameters"]) == metrics["parameters"]
    verdict = config["chosen"]["verdict"]
    assert metrics["verdict"] == 0 and verdict["level"] == "good" and "the robot's file" in verdict["reason"]


@pytest.mark.slow
def test_the_model_is_loaded_and_exported_and_the_file_has_what_was_identified(identified, tmp_path):
    run = load(identified)
    state = np.random.default_rng(1).normal(size=(3, 2))
    assert_allclose(run.parameters.coulomb, FRICTION["coulomb"], atol=0.05)
    export_c(functions_of_run(run, names=["inverse_dynamics"]), tmp_path / "c")
    in_c = load_c(tmp_path / "c").inverse_dynamics
    assert_allclose(in_c(*state), run.dynamics.inverse_dynamics(*state), rtol=1e-12)
    robot = read_robot(identified / "arm_identified.urdf")
    assert_allclose(robot.tree.inertias, run.parameters.inertias, rtol=1e-12, atol=1e-14)
    assert_array_equal(robot.damping, run.parameters.viscous)
    assert re.search(r"Armature, .*: shoulder 0\.\d+, elbow 0\.\d+", (identified / "arm_identified.urdf").read_text())


def test_ruined_log_is_refused_without_a_robots_file(workplace, capsys):
    log = dict(np.load("log.npz"))
    for name, factor, words in (("turned", -1, ""), ("milli", 1000, "times the tree's; check the unit of tau")):
        np.savez("ruined.npz", **{**log, "tau": factor * log["tau"]})
        # The check of the log sees some of them before.
        status = exit_status(identify, "--robot arm.urdf --accept-log --data ruined.npz --out", name, QUICK)
        told = capsys.readouterr()
        assert status == 1 and told.err.startswith("error: the fit is refused: ") and words in told.err
        assert "no arm_identified.urdf: the fit is refused" in told.out
        assert "10 blocks" not in told.out and "blocks of time of the one trajectory" in told.out
        folder = workplace / name
        assert json_of(folder / "metrics.json")["verdict"] == 2 and not list(folder.glob("*.urdf"))


def test_mistakes_are_one_line(workplace, capsys):
    log = dict(np.load("log.npz"))
    np.savez("other.npz", **{**log, "joint_names": ["elbow", "wrist"]})
    np.savez("one.npz", t=log["t"], q=log["q"][:, :1], tau=log["tau"][:, :1])
    np.savez("silent.npz", t=log["t"], q=log["q"])
    (workplace / "broken.urdf").write_text("<robot>")
    rows = {
        "--data other.npz": "joint 'shoulder' is not in the data (elbow, wrist)",
        "--data one.npz": "the data have 1 joints, the robot 2",
        "--data silent.npz": "column tau is missing",
        "--robot broken.urdf": "not XML",
        "--velocity-scale 0": "velocity_scale is 0.0",
        "--window 0.3": "--window is for --by motions or both",
        "--by motions --window -1": "window is -1.0; expected a positive number",
        "--by forces": "choose from torques, motions, both",
    }
    assert_refused(capsys, identify, rows.items(), LOG, out=workplace / "refused")


def test_trajectories_are_held_out_whole_and_one_in_blocks_of_time():
    six, one = (motions(0, samples=samples, trajectories=count) for samples, count in ((10, 6), (60, 1)))
    for asked, held in ((None, [2]), ("0,5", [0, 5])):
        parts = split_log(log_of(six, "six"), asked, validation=False)
        assert np.unique(parts.sets.test.trajectory).tolist() == held and not parts.blocks
    parts = split_log(log_of(one, "one"), validation=False)
    assert parts.blocks and len(parts.sets.train.t) == 48
    test = parts.sets.test
    assert [test.label[k] for k in np.unique(test.trajectory)] == ["0[2]", "0[7]"]
    with one_line("leave 0 for training; at least 2 in all"):
        split_log(log_of(one, "one"), "0", validation=False)
