"""`check_data` as the shell calls it, and `--cutoff` where commands train on logs."""

import contextlib

import numpy as np
import pytest

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import check_data, train_delan
from dln_jax.cli.encoders import prepare_log
from dln_jax.data import schema
from tests.calls import assert_refused, command, exit_status, json_of, refused

RATE = 100.0


@pytest.fixture
def log(tmp_path):
    """A pendulum that is driven, from its encoder."""
    random = np.random.default_rng(0)
    t, runs = np.arange(400) / RATE, 4
    q, qd, qdd = np.zeros((3, runs, len(t)))
    for run in range(runs):
        for w in (2.0, 5.0, 9.0):
            a, phase = random.uniform(0.3, 0.6), random.uniform(0, 6)
            q[run] += a * np.sin(w * t + phase)
            qd[run] += a * w * np.cos(w * t + phase)
            qdd[run] -= a * w**2 * np.sin(w * t + phase)
    tau = 0.4 * qdd + 3.0 * np.sin(q)
    path = tmp_path / "log.npz"
    np.savez(
        path,
        t=np.tile(t, runs),
        q=q.reshape(-1, 1) + 5e-4 * random.normal(size=(q.size, 1)),
        tau=tau.reshape(-1, 1) + 0.02 * random.normal(size=(q.size, 1)),
        trajectory=np.repeat(np.arange(runs), len(t)),
        label=np.array(["a", "b", "c", "d"]),
    )
    return path


def test_a_log_is_examined(log, tmp_path, capsys):
    command(check_data, "--data", log, "--out", tmp_path / "check")
    said = capsys.readouterr().out
    assert "1600 samples of 4 trajectories, 1 joints" in said and "warning: accelerations by differences" in said
    folder = tmp_path / "check"
    assert (folder / "log.png").stat().st_size > 10_000
    assert (folder / "report.txt").read_text().strip() in said
    findings = json_of(folder / "findings.json")["findings"]
    assert [each["check"] for each in findings] == ["raw-differences"]
    assert 3 < json_of(folder / "metrics.json")["cutoff_hz"] < 30
    assert "not there" not in refused(capsys, check_data, "--data", tmp_path / "none.npz")


def test_a_log_with_an_error_ends_with_status_1_and_a_whole_page(log, tmp_path, capsys):
    arrays = dict(np.load(log))
    np.savez(tmp_path / "degrees.npz", **{**arrays, "q": np.degrees(arrays["q"])})
    status = exit_status(check_data, "--data", tmp_path / "degrees.npz", "--out", tmp_path / "check")
    assert status == 1
    assert "error: q of joint 1 goes to" in (tmp_path / "check" / "report.txt").read_text()
    assert {each.name for each in (tmp_path / "check").iterdir()} >= {"findings.json", "metrics.json", "log.png"}


@pytest.mark.slow
def test_missing_rates_of_a_noisy_log_come_from_filtered_q_unless_the_user_declines(log, tmp_path, capsys):
    errors = {}
    for name, options in (("default", []), ("auto", ["--cutoff", "auto"]), ("raw", ["--cutoff", "inf"])):
        out = ["--out", tmp_path / name, "--no-figures", "--no-low-latency", "--no-uncertainty"]
        given = ("--data", log, "--model trigonometric --degree 1 --test d", *options, *out)
        with pytest.raises(SystemExit) if name == "raw" else contextlib.nullcontext():
            command(train_delan, *given)
        said = capsys.readouterr().out
        reason = "q is filtered before it is differentiated: accelerations by differences of this q have noise of"
        assert (reason in said) == (name == "default")
        assert ("q filtered without delay at" in said) == (name != "raw")
        cause = "; in the log, accelerations by differences of this q have noise of"
        assert ("verdict: good" in said, cause in said) == (name != "raw", name == "raw")
        errors[name] = json_of(tmp_path / name / "metrics.json")["torque_mse"]
    assert errors["default"] == errors["auto"] < 0.1 * errors["raw"]
    config = json_of(tmp_path / "default" / "config.json")
    assert 3 < config["chosen"]["cutoff_hz"] < 30


def prepared(path, **options):
    return prepare_log(arguments_of(train_delan.Arguments, data=path, **options), schema.load(path), path)


def test_a_log_is_filtered_by_default_only_where_noise_matters_and_rates_are_missing(log, tmp_path):
    filtered, lines, causes, _ = prepared(log)
    assert filtered is not None and 3 < filtered.cutoff < 30 and causes == () and "q is filtered" in lines[0]
    arrays = dict(np.load(log))
    np.savez(tmp_path / "rates.npz", **arrays, qd=np.gradient(arrays["q"], axis=0), qdd=arrays["tau"])
    assert prepared(tmp_path / "rates.npz", accept_log=True)[0] is None, "measured rates stay"
    t = arrays["t"]
    exact = {**arrays, "q": np.sin(5 * t + arrays["trajectory"])[:, None]}
    np.savez(tmp_path / "exact.npz", **exact)
    filtered, lines, causes, _ = prepared(tmp_path / "exact.npz")
    assert filtered is None and not any("filtered" in line for line in lines), "exact data are used as they are"
    short = {key: value if key == "label" else value[arrays["t"] < 0.05] for key, value in arrays.items()}
    np.savez(tmp_path / "short.npz", **short)
    assert prepared(tmp_path / "short.npz", accept_log=True)[0] is None


def test_faults_of_a_log_that_no_filter_repairs_are_causes_of_a_verdict(log, tmp_path):
    arrays = dict(np.load(log))
    np.savez(tmp_path / "degrees.npz", **{**arrays, "q": np.degrees(arrays["q"])})
    _, _, causes, _ = prepared(tmp_path / "degrees.npz", accept_log=True)
    assert any("q of joint 1 goes to" in cause for cause in causes)


def test_errors_in_a_log_stop_a_training_unless_they_are_accepted(log, tmp_path, capsys):
    arrays = dict(np.load(log))
    np.savez(tmp_path / "degrees.npz", **{**arrays, "q": np.degrees(arrays["q"])})
    given = ["--data", tmp_path / "degrees.npz", "--model", "trigonometric", "--degree", "1", "--out", tmp_path / "run"]
    said = refused(capsys, train_delan, *given)
    assert "convert to radians" in said and "--accept-log" in said
    assert f"check_data --data {tmp_path / 'degrees.npz'} says more" in said
    assert not (tmp_path / "run").exists()
    command(train_delan, *given, "--accept-log --no-figures --no-low-latency")
    said = capsys.readouterr().out
    assert "warning: q of joint 1 goes to" in said and "error:" not in said


def test_joints_of_a_gripper_are_held(log, tmp_path, capsys):
    pytest.importorskip("mujoco", reason="MuJoCo reads the robot files; it is in the extra [robot]")
    links = "".join(
        f'<link name="{name}"><inertial><origin xyz="0 0 -0.3"/><mass value="1"/>'
        '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name in ("arm", "finger")
    )
    joints = "".join(
        f'<joint name="{name}_joint" type="continuous"><parent link="{parent}"/><child link="{name}"/>'
        '<axis xyz="0 1 0"/></joint>'
        for parent, name in (("ground", "arm"), ("arm", "finger"))
    )
    robot = tmp_path / "robot.urdf"
    robot.write_text(f'<robot name="robot"><link name="ground"/>{links}{joints}</robot>')
    given = ["--data", log, "--robot", robot, "--no-figures"]
    assert "--lock NAME,NAME" in refused(capsys, check_data, *given, "--out", tmp_path / "all")
    command(check_data, *given, "--lock", "*finger*", "--out", tmp_path / "held")
    assert "robot: the motions determine" in capsys.readouterr().out
    assert "--lock is for joints of --robot" in refused(capsys, check_data, "--data", log, "--lock finger")


def test_options_that_make_no_filter_are_refused(log, tmp_path, capsys):
    rows = [
        ("--cutoff fast", "expected Hz, a positive number, or auto"),
        ("--cutoff 90", "--cutoff 90: cutoff is 90 Hz; expected less than 50 Hz"),
        ("--decimate 3", "add --cutoff auto"),
    ]
    assert_refused(capsys, train_delan, rows, "--data", log, out=tmp_path / "run")
