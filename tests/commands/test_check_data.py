"""`check_data` as the shell calls it, and `--cutoff` where commands train on logs."""

import json

import numpy as np
import pytest

from dln_jax.commands import check_data, train_delan
from tests.calls import command, refused

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
    assert (folder / "page.txt").read_text().strip() in said
    findings = json.loads((folder / "findings.json").read_text())["findings"]
    assert [each["check"] for each in findings] == ["raw-differences"]
    assert 3 < json.loads((folder / "metrics.json").read_text())["cutoff_hz"] < 30
    assert "not there" not in refused(capsys, check_data, "--data", tmp_path / "none.npz")


def test_training_filters_when_it_is_asked_to_and_says_so_when_it_does_not(log, tmp_path, capsys):
    errors = {}
    for name, options in (("raw", []), ("filtered", ["--cutoff", "auto"])):
        out = ["--out", tmp_path / name, "--no-figures", "--no-low-latency"]
        command(train_delan, "--data", log, "--model", "trigonometric", "--degree", "1", "--test", "d", *options, *out)
        said = capsys.readouterr().out
        assert ("raw finite differences, which amplify noise: --cutoff auto" in said) == (name == "raw")
        assert ("q filtered without delay at" in said) == (name == "filtered")
        assert "warning: accelerations by differences of this q" in said
        errors[name] = json.loads((tmp_path / name / "metrics.json").read_text())["torque_mse"]
    assert errors["filtered"] < 0.1 * errors["raw"]
    config = json.loads((tmp_path / "filtered" / "config.json").read_text())
    assert config["cutoff"] == "auto" and 3 < config["chosen"]["cutoff_hz"] < 30


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cutoff", "fast"], "expected Hz, a positive number, or auto"),
        (["--cutoff", "90"], "--cutoff 90: cutoff is 90 Hz; expected less than 50 Hz"),
        (["--decimate", "3"], "add --cutoff auto"),
    ],
)
def test_options_that_make_no_filter_are_refused(log, capsys, options, message):
    assert message in refused(capsys, train_delan, "--data", log, *options)
