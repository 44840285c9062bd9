"""One command explores, learns and swings up, and refuses mistakes before anything is written."""

import json

import pytest
from calls import command, refused

from dln_jax.cli.commands import swing_up


@pytest.mark.slow
def test_a_run_stores_data_numbers_and_pictures(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("dln_jax.training.swing_ups.run.MOST_SHOWN", 2)
    few = ("--seconds-of-data", 12, "--starts", 2, "--estimator", "differences")
    command(swing_up, "--plant", "furuta", "--model", "known", *few, "--out", tmp_path / "run")
    found = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert found["success_share"] == 1 and found["not_finite"] == 0 and found["torque_nmse"] < 1e-20
    assert {each.name for each in (tmp_path / "run").iterdir()} >= {
        "config.json",
        "data.npz",
        "swing-ups.png",
        "swing-up.gif",
    }
    assert "100.0% of 2 starts up" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--plant", "acrobot"), "choose from cart-pole, rotary-pendulum, furuta, or a file"),
        (("--plant", "none.xml", "--actuated", "1"), "none.xml"),
        (("--plant", "furuta", "--actuated", "1"), "belong to a file"),
        (("--model", "feed-forward"), "choose from"),
        (("--seconds-of-data", 1), "expected at least 12 s"),
        (("--estimator", "luenberger"), "choose from"),
        (("--recover", "never"), "choose from swing-up, plans"),
        (("--push", "inf"), "--push is inf; expected a finite number"),
        (("--starts", 0), "starts is 0"),
        (("--seed", -1), "seed is -1"),
    ],
    ids=lambda given: given if isinstance(given, str) else given[0],
)
def test_mistakes_are_one_line_and_leave_nothing(capsys, tmp_path, arguments, message):
    assert message in refused(capsys, swing_up, *arguments, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--actuated", "wrist"), "no joint 'wrist'; the joints are 0 shoulder, 1 elbow"),
        (("--actuated", "0,1"), "all 2 joints have a motor"),
        ((), "no joint has a motor"),
        (("--actuated", "elbow"), "states no limit of the motor of joint 'elbow'"),
        (("--actuated", 1, "--control", -1), "control is [-1.0]"),
        (("--actuated", 1, "--control", 5, "--seconds-of-data", 4), "expected at least 12 s"),
        (("--actuated", 1, "--control", 5, "--model", "known"), "the model of a file is identified"),
    ],
    ids=["name", "all", "none", "limit", "negative", "seconds", "model"],
)
def test_mistakes_with_a_file_are_one_line_and_leave_nothing(capsys, tmp_path, arguments, message):
    pytest.importorskip("mujoco", reason="MuJoCo simulates the plant; it is in the extra [robot]")
    rod = '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".2"/>'
    links = (
        f'<joint name="shoulder" axis="0 1 0"/>{rod}<body pos="0 0 -.3"><joint name="elbow" axis="0 1 0"/>{rod}</body>'
    )
    file = tmp_path / "mine.xml"
    file.write_text(f"<mujoco><worldbody><body>{links}</body></worldbody></mujoco>")
    assert message in refused(capsys, swing_up, "--plant", file, *arguments, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()
