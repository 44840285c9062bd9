"""--model auto end to end: the model that each arm gets, what is printed and stored, and what is refused."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from calls import assert_refused, json_of, refused
from planar_arm import ARM, FRICTION, motions

from dln_jax import InputError, dynamics, joint_dissipation, load, tree_system
from dln_jax.commands import train_delan
from dln_jax.data import schema
from dln_jax.data.log import read_log, split_log
from dln_jax.data.robot_files import mjcf
from dln_jax.data.robots import Robot
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.fits import automatic, direct
from dln_jax.learning.fits.settings import Automatic

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


def chosen(folder, **more):
    """The fit of a selection with the robot's file."""
    log = read_log("rigid.npz", robot="arm.xml")
    return Automatic().fit(log, split_log(log), Context(folder=folder, **more))


def test_the_tree_of_a_robot_is_kept_where_it_explains_all_but_the_noise(workplace, capsys):
    fit = chosen(workplace)
    stored = json_of(workplace / "selection.json")
    assert stored["kept"] == fit.name == "rigid-tree" and "torque noise" in stored["ended"]
    assert len(stored["candidates"]) == 1
    found = fit.dynamics.inverse_dynamics
    true = dynamics(tree_system(ARM, joint_dissipation(*FRICTION.values()))).inverse_dynamics
    state = (np.array([0.3, -0.5]), np.array([0.7, 0.4]), np.array([1.0, -2.0]))
    np.testing.assert_allclose(found(*state), true(*state), atol=0.05)


def test_finished_candidates_are_stored_and_not_fitted_again(workplace, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(automatic, "noise_of", lambda *_: np.full(2, np.nan))  # so that all candidates are tried
    names = ("Trigonometric", "LearnedTree", "Kernel", "Network")
    for name in names:
        monkeypatch.setattr(automatic, name, lambda **_: SimpleNamespace(fit=interrupted))
    with pytest.raises(KeyboardInterrupt):
        chosen(tmp_path)
    kept = load(tmp_path / "candidates/rigid-tree")

    monkeypatch.setattr(automatic, "identify_robot", interrupted)
    for name in names:
        monkeypatch.setattr(automatic, name, lambda **_: SimpleNamespace(fit=lambda *_: "not in this test"))
    fit = chosen(tmp_path, resume=True)
    assert fit.description == kept.description
    jax.tree.map(np.testing.assert_array_equal, fit.parameters, kept.parameters)
    assert json_of(tmp_path / "candidates/trigonometric/candidate.json") == {"reason": "not in this test"}


def test_a_kinematic_prior_and_parents_reach_the_search(workplace, capsys, monkeypatch):
    seen = {}

    def searched(*data, parents, settings, velocity_scale, **others):
        seen.update(parents=tuple(parents), scale=velocity_scale, **settings._asdict())
        raise InputError("seen")

    monkeypatch.setattr(direct, "fit_tree", searched)
    options = "--kinematic-prior prior.json --parents 0,1 --out near --needs"
    assert "seen" in refused(capsys, train_delan, TREE, options, PLAIN.replace("]}", '], "velocity_scale": 0.02}'))
    assert seen["parents"] == (-1, 0) and seen["scale"] == 0.02
    assert len(seen["kinematic_prior"].frames.rotations) == 2
    assert seen["kinematic_prior"].angle == pytest.approx(np.radians(10))


def test_mistakes_are_one_line(workplace, capsys):
    (workplace / "wrong.json").write_text('{"colour": "red"}')
    rows = {
        "--width 4": "--width is an option of networks",
        "--degree 2": "--degree is an option of --model trigonometric",
        "--lock x": "--lock is for joints of --robot",
        "--robot none.urdf": "none.urdf",
        "--model structured-delan --robot arm.xml": "--robot is an option of --model auto",
        "--model structured-delan --parents 0,1": "--parents is an option of --model auto",
        "--model trigonometric --processes 2": "--processes is an option of networks",
    }
    assert_refused(capsys, train_delan, rows.items(), "--model auto --data rigid.npz", out=workplace / "refused")
    rows = [
        ("--parents 0,3", "--parents is '0,3'"),
        ("--kinematic-prior none.json", "none.json: no such file"),
        ("--kinematic-prior wrong.json", "wrong.json: expected"),
        ("--needs", PLAIN.replace("viscous", "stribeck"), "a learned tree has no stribeck friction"),
    ]
    assert_refused(capsys, train_delan, rows, TREE, out=workplace / "refused")
