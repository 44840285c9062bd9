"""--model auto end to end: which model is kept of which arm, what is printed and stored, and what is refused."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, refused

from dln_jax.commands import train_delan
from dln_jax.data.mjcf import mjcf
from dln_jax.data.robots import Robot
from dln_jax.learning import kinematics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.residual import Residual, with_residual
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial, tree_system
from dln_jax.runs import direct_fits
from dln_jax.zoo.run import load

LINK = inertial_parameters(2.0, [0.1, 0.05, 0.2], np.diag([0.03, 0.04, 0.02]))
ROWS = [[0.4, 0, 0.1, 0], [1.2, 0.2, 0.1, 0]]
ARM = serial(*dh_frames(ROWS), [LINK] * 2, armature=np.array([0.1, 0.2]))
QUIET = ("--no-figures", "--no-low-latency", "--no-uncertainty")
PLAIN = '{"joints": ["revolute", "revolute"], "joint_friction": ["viscous"]}'


def log(stiffness, trajectories=8):
    """Motions of the arm with viscous friction, and a spring between its joints that is not of rigid bodies."""
    spring = Residual(potential=lambda q: stiffness * jnp.cos(q[0] - 2 * q[1]))
    system = with_residual(tree_system(ARM, joint_dissipation([0.4, 0.2])), spring)
    random, T = np.random.default_rng(0), 60
    t, trajectory = np.tile(0.05 * np.arange(T), trajectories), np.repeat(np.arange(trajectories), T)
    a, w, p = random.uniform([0.2, 1, 0], [0.9, 3, 6], (trajectories, 2, 3, 3)).transpose(3, 0, 1, 2)[:, trajectory]
    phase = w * t[:, None, None] + p
    q, qd, qdd = (x.sum(axis=2) for x in (a * np.sin(phase), a * w * np.cos(phase), -a * w * w * np.sin(phase)))
    tau = np.asarray(jax.jit(jax.vmap(dynamics(system).inverse_dynamics))(q, qd, qdd))
    noisy = tau + 0.02 * random.normal(size=tau.shape)
    return {"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": noisy, "trajectory": trajectory}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """Logs of the arm with and without the spring, its file with other masses, and a sketch of it."""
    folder = tmp_path_factory.mktemp("ladder")
    for name, stiffness in (("rigid", 0.0), ("spring", 1.5)):
        np.savez(folder / f"{name}.npz", **log(stiffness))
    one = log(0.0, trajectories=1)
    np.savez(folder / "one.npz", **one)
    free = np.tile([-np.inf, np.inf], (2, 1))
    rough = ARM._replace(inertias=0.8 * ARM.inertias)
    (folder / "arm.xml").write_text(mjcf(Robot(rough, np.zeros(2), np.zeros(2), free, free)))
    (folder / "sketch.json").write_text(json.dumps({"dh_rows": ROWS, "angle_degrees": 10}))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def ladder_of(folder):
    return json.loads((folder / "ladder.json").read_text())


def test_the_tree_of_a_robot_is_kept_where_it_explains_all_but_the_noise(workplace, capsys):
    pytest.importorskip("mujoco")
    command(train_delan, "--model", "auto", "--data", "rigid.npz", "--robot", "arm.xml", "--out", "known", *QUIET)
    said, stored = capsys.readouterr().out, ladder_of(workplace / "known")
    assert stored["kept"] == "rigid-tree" and "are the noise" in stored["ended"] and "│ rigid-tree " in said
    assert [rung["tried"] for rung in stored["rungs"]] == [True] + [False] * (len(stored["rungs"]) - 1)
    run = load(workplace / "known")
    assert run.description["name"] == "rigid-tree" and run.description["needs"]["joint_friction"]
    exact = dynamics(tree_system(ARM, joint_dissipation([0.4, 0.2])))
    state = (np.array([0.3, -0.5]), np.array([0.7, 0.4]), np.array([1.0, -2.0]))
    np.testing.assert_allclose(run.dynamics.inverse_dynamics(*state), exact.inverse_dynamics(*state), atol=0.05)


def test_a_potential_of_no_rigid_body_is_found_by_the_basis_that_has_it(workplace, capsys):
    command(train_delan, "--model", "auto", "--data", "spring.npz", "--needs", PLAIN, "--out", "spring", *QUIET)
    stored = ladder_of(workplace / "spring")
    assert stored["kept"] == "trigonometric" and len(stored["rungs"][0]["validation_nmse_joints"]) == 2
    assert "trigonometric: validation nMSE" in capsys.readouterr().out
    config = json.loads((workplace / "spring" / "config.json").read_text())
    assert len(config["chosen"]["validation_units"]) == 2 and config["model"] == "auto"


def test_a_sketch_and_parents_reach_the_search(workplace, monkeypatch):
    seen = {}

    def searched(needs, *data, parents, settings, velocity_scale, **others):
        seen.update(parents=parents, sketch=settings.sketch, angle=settings.sketch_angle, scale=velocity_scale)
        tiny = settings._replace(starts=1, iterations=10)
        return kinematics.fit_tree(
            needs, *data, parents=parents, settings=tiny, velocity_scale=velocity_scale, **others
        )

    monkeypatch.setattr(direct_fits, "fit_tree", searched)
    options = ("--model", "learned-tree", "--data", "rigid.npz", "--needs", PLAIN, "--velocity-scale", "0.02")
    command(train_delan, *options, "--sketch", "sketch.json", "--parents", "0,1", "--out", "sketched", *QUIET)
    assert seen["parents"] == (-1, 0) and seen["scale"] == 0.02
    np.testing.assert_allclose(seen["sketch"].rotations, ARM.rotations, atol=1e-12)
    assert seen["angle"] == pytest.approx(np.radians(10))


AUTO = ("--model", "auto", "--data", "rigid.npz")
TREE = ("--model", "learned-tree", "--data", "rigid.npz")
MISTAKES = {
    "width": ((*AUTO, "--width", "4"), "the ladder chooses by validation"),
    "degree": ((*AUTO, "--degree", "2"), "the ladder chooses by validation"),
    "hold": ((*AUTO, "--hold", "x"), "--hold is for joints of --robot"),
    "robot of a network": (("--data", "rigid.npz", "--robot", "arm.xml"), "--robot is for --model auto"),
    "robot that is not there": ((*AUTO, "--robot", "none.urdf"), "none.urdf"),
    "parents": ((*TREE, "--parents", "0,3"), "--parents is '0,3'"),
    "parents of a network": (("--data", "rigid.npz", "--parents", "0,1"), "--parents is for --model auto"),
    "sketch that is not there": ((*TREE, "--sketch", "none.json"), "none.json: no such file"),
    "sketch of something else": ((*TREE, "--sketch", "wrong.json"), "wrong.json: expected"),
    "scale": ((*AUTO, "--velocity-scale", "-1"), "velocity_scale is -1"),
    "scale without friction": ((*TREE, "--velocity-scale", "0.1"), "--velocity-scale is for dry friction"),
    "friction that no learned tree has": (
        (*TREE, "--needs", PLAIN.replace("viscous", "stribeck")),
        "a learned tree has no stribeck friction",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(workplace, capsys, mistake):
    arguments, message = MISTAKES[mistake]
    (workplace / "wrong.json").write_text('{"colour": "red"}')
    if "arm.xml" in arguments or "none.urdf" in arguments:
        pytest.importorskip("mujoco")
    assert message in refused(capsys, train_delan, *arguments, "--out", workplace / "refused")
    assert not (workplace / "refused").exists()
