"""The command line end to end on a tiny budget: what it writes, what it refuses, and how it survives a kill."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, refused
from planar_arm import motions
from small_logs import small_log

from dln_jax import load
from dln_jax.commands import export_c, make_data, train_delan
from dln_jax.data import schema

ROOT = Path(__file__).parents[3]
TINY = "--optimizer adam --steps 40 --batch 64 --width 4 --depth 1 --precision f64"
BRIEF = "--no-figures --no-uncertainty"
FILES = {
    ".lock",
    "config.json",
    "metrics.json",
    "model.json",
    "model.safetensors",
    "checkpoint.json",
    "decomposition.png",
    "training.png",
    "tip_paths.png",
    "uncertainty.json",
    "uncertainty.png",
    "uncertainty.safetensors",
}


@pytest.fixture(scope="module")
def trained(folder):
    """The run folder of the script's defaults, but for the budget."""
    command(train_delan, TINY)
    return folder / "runs/train_delan-1"


def test_a_run_writes_all_its_files(trained):
    names = {path.name for path in trained.iterdir()}
    (checkpoint,) = names - FILES
    assert names > FILES and re.fullmatch(r"checkpoint-\d{9}\.safetensors", checkpoint)
    metrics = json_of(trained / "metrics.json")
    named = "forward_mse compile_seconds one_step_p99_us coverage_95_worst_joint_share out_of_distribution_share"
    assert set(metrics) >= set(named.split()) and all(isinstance(value, int | float) for value in metrics.values())
    assert metrics["parameters"] == (4 * 4 + 4) * 2 + (4 * 3 + 3) + (4 + 1)
    config = json_of(trained / "config.json")
    assert config["width"] == 4 and "out" not in config


def test_a_finished_run_is_never_overwritten_and_resumes_to_itself(trained, folder, capsys):
    before = {path: path.read_bytes() for path in trained.iterdir()}
    for options, words in (
        ((TINY, "--data none.npz", "--out", trained), "already contains a run"),
        (("--resume --width 5", "--out", trained), "started with width = 4"),
        (("--resume", "--out", folder / "void"), "holds none"),
        (("--resume",), "holds none"),
    ):
        assert words in refused(capsys, train_delan, *options)
    assert {path: path.read_bytes() for path in trained.iterdir()} == before and not (folder / "void").exists()
    command(train_delan, "--out", trained, "--resume --no-figures")
    assert (trained / "model.safetensors").read_bytes() == before[trained / "model.safetensors"]


def test_a_killed_run_resumes_to_the_same_parameters(folder):
    """SIGKILL after the first checkpoint, then --resume: the model equals an unbroken run's to the last bit."""
    settings = f"--optimizer adam --steps 1200 --width 8 --depth 1 --batch 32 {BRIEF} --scene pendulum"
    command(train_delan, settings, "--out unbroken")
    line = [sys.executable, "-m", "scripts.train_delan", *settings.split(), "--out", str(folder / "killed")]
    environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
    with subprocess.Popen(line, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + 120
        while not (folder / "killed/checkpoint.json").exists():
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.005)
        process.kill()
    assert not (folder / "killed/model.json").exists(), "the run was over before it could be killed"
    command(train_delan, "--out killed --resume --no-figures")
    one, other = ((folder / name / "model.safetensors").read_bytes() for name in ("unbroken", "killed"))
    assert one == other


def test_a_loss_that_explodes_keeps_the_last_good_model(folder, capsys):
    line = refused(capsys, train_delan, TINY, "--scene pendulum --learning-rate 1e19", BRIEF, "--out exploded")
    assert re.search(r"after step \d+", line) and "lower --learning-rate" in line
    assert np.isfinite(load("exploded").dynamics.inverse_dynamics(*np.ones((3, 1)))).all()


def test_out_of_time_is_a_run_that_has_learned_and_can_go_on_with_more(folder, capsys):
    options = f"--optimizer adam --width 3 --depth 1 {BRIEF} --scene pendulum --steps 400 --seconds 1e-6"
    command(train_delan, options, "--out late")
    assert "time is up at step" in capsys.readouterr().out
    early = json_of(folder / "late/metrics.json")
    assert 0 < early["best_step"] == early["steps"] < 400
    command(train_delan, "--out late --resume --seconds 2e-6", BRIEF)
    assert json_of(folder / "late/metrics.json")["steps"] == 2 * early["steps"]


GOOD = small_log(2)


def marked(key, mark):
    """Data with a mark for a missing value among the numbers of a key."""
    return {key: np.where(np.arange(40).reshape(20, 2) == 7, mark, GOOD[key])}


WRONG_DATA = [
    ({"q": None}, "key 'q' is missing"),
    ({"tau": np.zeros((20, 2))}, "tau is constant"),
    ({"label": [*"abcdef"]}, "--test f", "'f' has no samples"),
    ({"tau": None}, "dln-jax train_hnn_task --task measured --data"),
    ({"t": None}, "give --rate HZ"),
    (marked("tau", 1e308), "tau has numbers of up to 1.0e+308"),
    ({"tau": 1e10 * marked("tau", 1e18)["tau"]}, "--optimizer adam", "overflow in float32"),
    (marked("qd", 1e40), "qd has numbers of up to 1.0e+40 where half are below"),
    (marked("qd", 1e120), "--width 4", "qd has numbers of up to 1.0e+120, whose squares"),
    ({"tau": np.full((20, 2), 1e-170)}, "squares vanish"),
]
MISTAKES = {
    "--data none.npz": "no such file",
    "--test z": "no trajectory is labelled 'z'",
    "--scene pendulum": "has 1 joints",
    "--scene teapot": "choose from two-link-arm",
    "--needs revolute": "a letter r or p for each joint",
    "--activation sigmoidal": "tanh",
    "--steps 0": "steps is 0",
    "--width -1": "width is -1",
    "--seed -1": "seed is -1",
    "--seed 4294967295 --seeds 2": "seed is 4294967295 and 1 after it",
    "--degree 2": "--degree is an option of --model trigonometric",
    "--rate 100": "leave --rate out",
    "--units degrees": "units are for CSV",
    "--model feed-forward --objective forward": "feed-forward model has no energy",
    "--model auto --objective both": "--objective is an option of networks",
    "--model trigonometric-kernel --objective both": "--objective is an option of networks",
    "--batch 64": "--batch is an option of --optimizer adam",
    "--learning-rate nan --optimizer adam": "--learning-rate is nan",
    "--seconds nan": "seconds is nan",
    "--model trigonometric --width 4": "--width is an option of",
    "--model trigonometric --optimizer adam": "--optimizer is an option of",
    "--model learned-tree --width 3": "--width is an option of networks",
    "--model trigonometric --samples 9": "--samples",
    "--model trigonometric-kernel --samples 0": "samples is 0",
    "--optimizer gauss-newton --precision f32": "gauss-newton needs f64",
    "--target 1 --width 4": "--width is for one network, and --target grows several",
    "--target 1e-8 --model black-box-delan": "--target is an option of --model structured-delan",
}


def test_mistakes_are_one_line_and_leave_nothing_behind(folder, capsys):
    path, out = folder / "wrong.npz", folder / "refused"
    for changes, *row in WRONG_DATA:
        np.savez(path, **{key: value for key, value in {**GOOD, **changes}.items() if value is not None})
        assert_refused(capsys, train_delan, [row], "--data", path, out=out)
    np.savez(path, **GOOD)
    assert_refused(capsys, train_delan, MISTAKES.items(), "--data", path, out=out)


def test_a_bare_recording_of_an_arm_with_friction_is_fitted_exactly_by_default(folder, capsys):
    """One CSV file without t, trajectory and needs: two coupled joints with viscous and dry friction."""
    log = motions(0, samples=601)
    titles = "q1 [deg],q2 [deg],qd1 [deg/s],qd2 [deg/s],qdd1 [rad/s2],qdd2 [rad/s2],tau1 [mN m],tau2 [mN m]"
    rows = np.hstack([np.degrees(log.q), np.degrees(log.qd), log.qdd, 1e3 * log.tau])
    np.savetxt("bare.csv", rows, delimiter=",", header=titles, comments="")
    command(train_delan, "--data bare.csv --rate 100 --out bare", BRIEF)
    said = capsys.readouterr().out
    assert "one recording: cut into blocks of time, 8 for training, 1 for validation, 1 for the test" in said
    assert "friction of joints: viscous, coulomb, offset" in said
    assert said.splitlines()[-1].startswith("verdict: good") and "Stopped: trigonometric is exact." in said
    metrics, stored = (json_of(folder / f"bare/{name}.json") for name in ("metrics", "selection"))
    assert metrics["torque_mse"] < 1e-18 and metrics["verdict"] == 0 and metrics["validation_nmse"] < 1e-18
    assert stored["kept"] == "trigonometric" == load("bare").description["name"]
    assert stored["ended"] == "trigonometric is exact"


def test_exports_are_numbered_beside_their_run(trained, capsys):
    for _ in range(2):
        command(export_c, "--run", trained, "--functions energy")
    out = trained.with_name(f"{trained.name}-c-2")
    assert "already contains an export" in refused(capsys, export_c, "--run", trained, "--out", out)


def test_a_model_that_is_worse_than_a_constant_is_refused_in_words(folder, capsys):
    np.savez("noise.npz", **small_log(1, trajectories=6, samples=10))
    status = exit_status(train_delan, "--data noise.npz --model trigonometric --degree 2 --out noise", BRIEF)
    assert status == 1
    assert capsys.readouterr().err.startswith("error: the fit is refused: the torque of joint 1 is predicted")
    assert json_of(folder / "noise/metrics.json")["verdict"] == 2


def test_data_are_made_read_back_and_never_overwritten_unasked(folder):
    made = "--scene chain-3 --kind uniform --samples 20 --out chain.npz"
    command(make_data, made)
    assert schema.load("chain.npz").degrees_of_freedom == 3
    command(make_data, made, "--overwrite")


def test_mistakes_of_making_data_are_one_line(folder, capsys):
    Path("there.npz").touch()
    assert "exists" in refused(capsys, make_data, "--scene chain-3 --kind uniform --out there.npz")
    rows = {"--scene chain-3": "choose another --kind", "--scene chain-3 --kind uniform --samples 0": "samples is 0"}
    assert_refused(capsys, make_data, rows.items(), out=folder / "none.npz")
