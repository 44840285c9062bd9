"""The command end to end: a URDF and a log become a run folder, a robot's file and C; mistakes are one line."""

import re

import jax
import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, one_line
from motions import sums_of_sines

from dln_jax.cli.commands import identify
from dln_jax.data import schema
from dln_jax.data.robots import read_robot
from dln_jax.export.c.run import export_run
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import tree_system
from dln_jax.training.identification.task import noises, split
from dln_jax.zoo.run import load

pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
LINK = """<link name="{name}"><inertial><origin xyz="0.1 0.05 0.2"/><mass value="{mass}"/>
<inertia ixx="0.03" iyy="0.04" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="continuous"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="0.2 0 0.1" rpy="{turn} 0 0"/><axis xyz="0 0 1"/><dynamics damping="0.2"/></joint>"""
URDF = "".join(
    [
        '<robot name="arm"><link name="base"/>',
        *(LINK.format(name=name, mass=mass) for name, mass in (("upper", 2.0), ("lower", 1.0))),
        JOINT.format(name="shoulder", parent="base", child="upper", turn=0.4),
        JOINT.format(name="elbow", parent="upper", child="lower", turn=1.2),
        "</robot>",
    ]
)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A robot's file with masses that are too small, and a log of the true one, columns the other way round."""
    folder = tmp_path_factory.mktemp("workplace")
    (folder / "arm.urdf").write_text(URDF)
    true = read_robot(folder / "arm.urdf").tree
    true = true._replace(inertias=1.5 * true.inertias, armature=np.array([0.1, 0.2]))
    friction = joint_dissipation([0.4, 0.2], [0.5, 0.1], [0.0, 0.3])
    random, t = np.random.default_rng(0), np.arange(0, 8, 0.02)
    states = sums_of_sines(t, *random.uniform([0.2, 1, 0], [0.8, 4, 6], (2, 3, 3)).transpose(2, 0, 1))
    tau = jax.jit(jax.vmap(dynamics(tree_system(true, friction)).inverse_dynamics))(*states)
    tau = np.asarray(tau) + 0.05 * random.normal(size=(len(t), 2))
    swapped = {key: x[:, ::-1] for key, x in zip(("q", "qd", "qdd", "tau"), (*states, tau), strict=True)}
    names = np.array(["elbow", "shoulder"])
    np.savez(folder / "log.npz", t=t, trajectory=np.zeros(len(t), int), joint_names=names, **swapped)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


@pytest.fixture(scope="module")
def identified(workplace):
    command(identify, "--robot arm.urdf --data log.npz --out run")
    return workplace / "run"


def test_a_run_folder_like_every_other(identified):
    names = {path.name for path in identified.iterdir()}
    assert names == {
        *(".lock", "config.json", "metrics.json", "model.json", "model.safetensors", "parameters.json", "report.txt"),
        *("torque.png", "friction.png", "arm_identified.urdf"),
        *("uncertainty.json", "uncertainty.safetensors", "uncertainty.png"),
    }
    metrics = json_of(identified / "metrics.json")
    assert all(isinstance(value, int | float) for value in metrics.values())
    assert metrics["nmse"] < 1.1 * metrics["least_squares_nmse"] + 1e-4 < metrics["file_nmse"]
    assert metrics["coverage_95_share"] > 0.85
    assert metrics["noise_joint_1"] == pytest.approx(0.05, rel=0.15)
    assert json_of(identified / "config.json")["consistent"] is True
    stored = json_of(identified / "parameters.json")
    assert len(stored["base"]) == metrics["base_parameters"] and len(stored["parameters"]) == metrics["parameters"]


def test_the_model_is_loaded_and_exported(identified, tmp_path):
    run = load(identified)
    state = np.random.default_rng(1).normal(size=(3, 2))
    np.testing.assert_allclose(run.parameters.coulomb, [0.5, 0.1], atol=0.05)
    export_run(identified, tmp_path / "c", functions=("inverse_dynamics",))
    from dln_jax.export.c.load import load_c

    in_c = load_c(tmp_path / "c").inverse_dynamics
    np.testing.assert_allclose(in_c(*state), run.dynamics.inverse_dynamics(*state), rtol=1e-12)


def test_the_file_has_what_was_identified(identified):
    robot, run = read_robot(identified / "arm_identified.urdf"), load(identified)
    np.testing.assert_allclose(robot.tree.inertias, run.parameters.inertias, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(robot.damping, run.parameters.viscous)
    assert re.search(r"Armature, .*: shoulder 0\.\d+, elbow 0\.\d+", (identified / "arm_identified.urdf").read_text())
    assert (identified.parent / "arm.urdf").read_text() == URDF


def test_least_squares_that_is_no_body_is_kept_without_a_file(workplace, capsys):
    command(identify, "--robot arm.urdf --data log.npz --out free --no-consistent --no-figures --robust")
    said = capsys.readouterr().out
    assert "no arm_identified.urdf: the least-squares links behind" in said
    assert "10 blocks" not in said and "blocks of time of the one trajectory" in said
    assert not list((workplace / "free").glob("*.urdf")) and load(workplace / "free").dynamics is not None


def test_sound_log_is_good(identified):
    metrics = json_of(identified / "metrics.json")
    verdict = json_of(identified / "config.json")["chosen"]["verdict"]
    assert metrics["verdict"] == 0 and verdict["level"] == "good" and "the robot's file" in verdict["reason"]
    assert metrics["noise_nmse"] < metrics["nmse"] < 0.05 < metrics["file_nmse"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda tau: -tau, "no such robot"),
        (lambda tau: 1e3 * tau, "times the tree's; check the unit of tau"),
    ],
    ids=["all-signs", "millinewton-metres"],
)
def test_ruined_log_is_refused_without_a_robots_file(workplace, capsys, spoil, said, request):
    name = request.node.callspec.id
    log = dict(np.load(workplace / "log.npz"))
    np.savez(workplace / f"{name}.npz", **{**log, "tau": spoil(log["tau"])})
    options = ("--robot", "arm.urdf", "--data", f"{name}.npz", "--out", name, "--no-figures", "--no-uncertainty")
    options += ("--accept-log",)  # the check of the log sees some of them before
    status = exit_status(identify, *options)
    told = capsys.readouterr()
    assert status == 1 and told.err.startswith("error: the fit is refused: ") and told.err.count("\n") == 1
    assert "verdict: refused: " in told.out and "no arm_identified.urdf: the fit is refused" in told.out
    assert said in told.err or said == "no such robot"
    assert not list((workplace / name).glob("*.urdf"))
    assert json_of(workplace / name / "metrics.json")["verdict"] == 2


@pytest.mark.slow
def test_spikes_ask_for_a_robust_fit(workplace, capsys):
    log, random = dict(np.load(workplace / "log.npz")), np.random.default_rng(2)
    hit = random.random(log["tau"].shape) < 0.01
    np.savez(workplace / "spikes.npz", **{**log, "tau": log["tau"] + 20 * hit * log["tau"].std(axis=0)})
    options = ("--robot", "arm.urdf", "--data", "spikes.npz", "--no-figures", "--no-uncertainty")
    with pytest.raises(SystemExit):
        command(identify, *options, "--out spiky")
    assert "give --robust" in capsys.readouterr().err
    command(identify, *options, "--out robust --robust")
    assert json_of(workplace / "robust" / "metrics.json")["verdict"] == 0


def test_mistakes_are_one_line(workplace, capsys):
    data = dict(np.load(workplace / "log.npz"))
    variants = {
        "other.npz": {**data, "joint_names": np.array(["elbow", "wrist"])},
        "three.npz": {
            key: np.hstack([x, x[:, :1]]) if np.ndim(x) == 2 else x for key, x in data.items() if key != "joint_names"
        },
        "silent.npz": {key: x for key, x in data.items() if key != "tau"},
    }
    for name, arrays in variants.items():
        np.savez(workplace / name, **arrays)
    (workplace / "broken.urdf").write_text("<robot>")
    rows = [
        ("--data other.npz", "joint 'shoulder' is not among the data's (elbow, wrist)"),
        ("--data three.npz", "the data have 3 joints, the robot 2"),
        ("--data silent.npz", "have no tau"),
        ("--robot broken.urdf", "not XML"),
        ("--regularisation 0", "regularisation is 0.0"),
        ("--velocity-scale 0", "velocity_scale is 0.0"),
    ]
    assert_refused(capsys, identify, rows, "--robot arm.urdf --data log.npz", out=workplace / "refused")


def test_trajectories_are_held_out_whole():
    random = np.random.default_rng(0)
    arrays = {key: random.normal(size=(60, 1)) for key in ("q", "qd", "qdd", "tau")}
    data = schema.from_arrays({**arrays, "t": np.tile(np.arange(10.0), 6), "trajectory": np.repeat(np.arange(6), 10)})
    sets = split(data, None)
    assert sorted(set(sets.test.trajectory)) == [2] and not sets.blocks
    assert sorted(set(split(data, ["0", "5"]).test.trajectory)) == [0, 5]
    one = schema.from_arrays(
        {**{key: x[:50] for key, x in arrays.items()}, "t": np.arange(50.0), "trajectory": np.zeros(50)}
    )
    blocks = split(one, None)
    assert blocks.blocks and [blocks.test.label[k] for k in np.unique(blocks.test.trajectory)] == ["0[2]", "0[7]"]
    assert len(blocks.train.t) == 40
    with one_line("one only"):
        split(one, ["0"])
    with one_line("expected 2 positive numbers"):
        noises("1", 2)
