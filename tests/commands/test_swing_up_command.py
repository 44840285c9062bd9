"""One command explores, learns and swings up, and refuses mistakes before anything is written."""

from functools import partial

import jax
import numpy as np
from calls import assert_refused, command, exit_status, json_of, refused

from dln_jax import InputError, build, describe
from dln_jax.commands import swing_up
from dln_jax.commands.learned_plants import Learned
from dln_jax.control.plants.exploring import Exploration, Explored, recording_of
from dln_jax.control.plants.runs import PlantRun, Trials
from dln_jax.control.plants.tuning import SwingUp, tune
from dln_jax.control.regulators import Regulator
from dln_jax.control.swing_up import SwingUpNumbers
from dln_jax.data import schema
from dln_jax.learning.recordings import FittedPlant

MOTOR, PLACE = "--actuated elbow --control 5", "dln_jax.commands.learned_plants"


def test_a_run_stores_data_numbers_and_pictures(tmp_path, monkeypatch):
    # A known model needs no exploration by the laws of learned ones, which take a minute to compile.
    monkeypatch.setattr(f"{PLACE}.Exploration", partial(Exploration, surplus=()))
    monkeypatch.setattr(f"{PLACE}.tune", partial(tune, sets=16))
    few = "--plant cart-pole --model known --seconds-of-data 12 --starts 2 --estimator differences --out"
    command(swing_up, few, tmp_path / "run")
    found = json_of(tmp_path / "run/metrics.json")
    assert found["success_share"] == 1 and found["stopped"] == 0 and found["farthest"] < 2
    files = {each.name for each in (tmp_path / "run").iterdir()}
    assert files >= {"config.json", "data.npz", "law.json", "model.json", "swing-ups.png"}


def test_mistakes_are_one_line_and_leave_nothing(capsys, tmp_path):
    rows = {
        "--plant acrobot": "choose from cart-pole, rotary-pendulum, or give",
        "--plant furuta --actuated 0,1": "all 2 joints have a motor",
        "--model feed-forward": "choose from identified, delan, known, analytic",
        "--seconds-of-data 1": "expected at least 12 s",
        "--recover never": "choose from swing-up, plans",
        "--push inf": "--push is inf; expected a finite number",
    }
    assert_refused(capsys, swing_up, rows.items(), out=tmp_path / "run")
    rows = [
        ("--actuated wrist", "no joint 'wrist'; the joints are 0 shoulder, 1 elbow"),
        ("--actuated 0,1", "all 2 joints have a motor"),
        ("no joint has a motor",),
        ("--actuated elbow", "has no limit for the motor of joint 'elbow'"),
        ("--actuated 1 --control -1", "control is [-1.0]"),
    ]
    file = two_links(tmp_path)
    assert_refused(capsys, swing_up, rows, "--plant", file, out=tmp_path / "run")
    # A time step that would fill the memory.
    file.write_text(file.read_text().replace("<mujoco>", '<mujoco><option timestep="1e-9"/>'))
    rows = [(MOTOR, "30 s of motion at 1e+09 Hz would need about")]
    assert_refused(capsys, swing_up, rows, "--plant", file, out=tmp_path / "run")


def test_a_recording_that_a_later_step_refuses_is_kept(capsys, tmp_path, monkeypatch):
    def learn(plant, *_, keep, **__):
        q = np.random.default_rng(0).normal(size=(2, 10, 2))
        runs = [PlantRun(np.arange(10) / 500, part, np.zeros((10, 1))) for part in q]
        keep(Explored(recording_of(runs, plant.layout), ()))
        raise InputError("the noise of q in the log is 0")

    monkeypatch.setattr(f"{PLACE}.learn_to_swing_up", learn)
    line = refused(capsys, swing_up, "--plant", two_links(tmp_path), MOTOR, "--out", tmp_path / "run")
    assert "the noise of q in the log is 0; the recording stays in" in line
    assert schema.load(tmp_path / "run/data.npz").q.shape == (20, 2)


def test_a_law_that_does_not_carry_over_to_the_plant_is_refused_with_the_reason(capsys, tmp_path, monkeypatch):
    def learn(plant, *_, **__):
        description = describe("planar-chain", precision="f64", needs=plant.layout.needs)
        fitted = FittedPlant(description, build(description).init(jax.random.key(0)))
        numbers = SwingUpNumbers(None, None, None, Regulator(np.zeros((1, 4)), None), 1.0, None, None)
        law = SwingUp(None, "repeated plans", numbers, 256, 1.0, 0.4, 1.4)
        return Learned(None, fitted, law, 9.0)

    few = Trials(np.array([np.inf, 1.0, np.inf]), ("'elbow' moves at 31/s",))
    monkeypatch.setattr(f"{PLACE}.learn_to_swing_up", learn)
    monkeypatch.setattr(f"{PLACE}.try_plant", lambda *_, **__: (few, []))
    assert exit_status(swing_up, "--plant", two_links(tmp_path), MOTOR, "--starts 3 --out", tmp_path / "run") == 1
    said = capsys.readouterr().out
    assert "verdict: refused: 33.3% of 3 starts are up" in said
    assert "1 of 3 were stopped; the first: 'elbow' moves at 31/s" in said


def two_links(folder):
    """The file of two rods without a limit of their motors."""
    (folder / "mine.xml").write_text(
        """<mujoco><worldbody><body><joint name="shoulder" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2"/>
        <body pos="0 0 -.3"><joint name="elbow" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2"/></body></body></worldbody></mujoco>"""
    )
    return folder / "mine.xml"
