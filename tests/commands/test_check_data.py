"""`check_data` as the shell calls it, and `--cutoff` where commands train on logs."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, refused
from motions import sums_of_sines

from dln_jax.commands import check_data, train_delan
from dln_jax.data.log import read_log


@pytest.fixture
def log(tmp_path, monkeypatch):
    """Four motions of a pendulum that is driven, from its encoder."""
    monkeypatch.chdir(tmp_path)
    random, t, trajectory = np.random.default_rng(0), np.tile(np.arange(400) / 100, 4), np.repeat(range(4), 400)
    sizes, phases = random.uniform([0.3, 0], [0.6, 6], (4, 3, 2)).transpose(2, 0, 1)[:, trajectory, None]
    q, _, qdd = sums_of_sines(t, sizes, np.array([2.0, 5.0, 9.0]), phases)
    noise = random.normal(size=(2, *q.shape))
    tau = 0.4 * qdd + 3.0 * np.sin(q) + 0.02 * noise[0]
    arrays = {"t": t, "trajectory": trajectory, "label": [*"abcd"], "q": q + 5e-4 * noise[1], "tau": tau}
    np.savez("log.npz", **arrays)
    np.savez("degrees.npz", **{**arrays, "q": np.degrees(arrays["q"])})
    return arrays


def test_a_log_is_examined(log, capsys):
    command(check_data, "--data log.npz --out check")
    said = capsys.readouterr().out
    assert "1600 samples of 4 trajectories, 1 joints" in said and "warning: accelerations differenced from q" in said
    assert Path("check/report.txt").read_text().strip() in said and Path("check/log.png").stat().st_size > 10_000
    findings = json_of(Path("check/findings.json"))["findings"]
    assert [each["check"] for each in findings] == ["raw-differences"]
    assert 3 < json_of(Path("check/metrics.json"))["cutoff_hz"] < 30


def test_a_log_with_an_error_ends_with_status_1_and_a_whole_page(log):
    assert exit_status(check_data, "--data degrees.npz --out check") == 1
    assert "error: q of joint 1 goes to" in Path("check/report.txt").read_text()


def test_missing_rates_of_a_noisy_log_come_from_filtered_q_unless_the_user_declines(log, capsys):
    errors = {}
    for name, *option in (("default",), ("raw", "--cutoff inf")):
        fit = "--data log.npz --model trigonometric --degree 1 --test d --no-figures --no-uncertainty"
        with pytest.raises(SystemExit) if option else contextlib.nullcontext():
            command(train_delan, fit, *option, "--out", name)
        said = capsys.readouterr().out
        assert ("q filtered without delay at" in said) == ("verdict: good" in said) == (name == "default")
        cause = "; in the log, accelerations differenced from q are"
        assert (cause in said) == (name == "raw")
        errors[name] = json_of(Path(name, "metrics.json"))["torque_mse"]
    assert errors["default"] < 0.1 * errors["raw"]
    assert 3 < json_of(Path("default/config.json"))["chosen"]["cutoff_hz"] < 30


def prepared(arrays, **changes):
    """Cutoff in Hz, lines and causes for a log with these columns."""
    np.savez("changed.npz", **{**arrays, **changes})
    log = read_log("changed.npz", accept_log=True)
    return log.smoothed and log.smoothed.cutoff, log.remarks, log.faults


def test_a_log_is_filtered_by_default_only_where_noise_matters_and_rates_are_missing(log):
    cutoff, lines, causes = prepared(log)
    assert 3 < cutoff < 30 and causes == () and "q is filtered" in lines[0]
    qd = np.gradient(log["q"], axis=0) / log["t"][1]
    assert prepared(log, qd=qd)[0] == cutoff, "most robots log no qdd"
    assert prepared(log, qd=qd, qdd=log["tau"])[0] is None, "measured rates stay"
    cutoff, lines, _ = prepared(log, q=np.sin(5 * log["t"] + log["trajectory"])[:, None])
    assert cutoff is None and not any("filtered" in line for line in lines), "exact data are used as they are"
    _, _, causes = prepared(log, q=np.degrees(log["q"]))
    assert any("q of joint 1 goes to" in cause for cause in causes), "no filter repairs this"
    short = {key: value if key == "label" else value[log["t"] < 0.05] for key, value in log.items()}
    assert prepared(short)[0] is None


def test_errors_in_a_log_stop_a_training_unless_they_are_accepted(log, capsys):
    given = "--data degrees.npz --model trigonometric --degree 1 --out run"
    said = refused(capsys, train_delan, given)
    assert (
        "convert to radians" in said
        and "--accept-log" in said
        and "details: dln-jax check_data --data degrees.npz" in said
    )
    assert not Path("run").exists()
    command(train_delan, given, "--accept-log --no-figures --no-uncertainty")
    said = capsys.readouterr().out
    assert "warning: q of joint 1 goes to" in said and "error:" not in said


def test_options_that_make_no_filter_are_refused(log, capsys):
    rows = {
        "--cutoff fast": "expected Hz, a positive number, or auto",
        "--cutoff 90": "--cutoff 90.0: cutoff is 90 Hz; expected less than 50 Hz",
    }
    assert_refused(capsys, train_delan, rows.items(), "--data log.npz", out=Path("run"))
