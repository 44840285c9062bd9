"""The command line end to end on a tiny budget: what it writes, what it refuses, and how it survives a kill."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import command, refused

from dln_jax.cli.commands import make_data, train_delan
from dln_jax.data import schema
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import chain
from dln_jax.scenes.poles import cart_pole
from dln_jax.zoo.run import load

ROOT = Path(__file__).parents[3]
NETWORK = ("--width", "4", "--depth", "1", "--precision", "f64")
TINY = ("--optimizer", "adam", "--steps", "40", "--batch", "64", "--no-low-latency", *NETWORK)
BRIEF = ("--no-figures", "--no-low-latency", "--no-uncertainty")
KINDS = {"q": "deg", "qd": "deg/s", "qdd": "rad/s2", "tau": "mN m"}
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
METRICS = {
    *(f"{name}_mse" for name in ("torque", "inertial", "coriolis", "gravity", "power", "forward")),
    *("parameters", "compile_seconds", "train_seconds", "one_step_p50_us", "one_step_p99_us"),
    *("coverage_95_share", "coverage_95_worst_joint_share", "out_of_distribution_share"),
}


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """An empty working folder with a cache of its own."""
    folder = tmp_path_factory.mktemp("workplace")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield folder


@pytest.fixture(scope="module")
def trained(workplace):
    """The run folder of the script's defaults, but for the budget."""
    command(train_delan, *TINY)
    return workplace / "runs" / "train_delan-1"


def test_a_run_writes_all_its_files(trained):
    names = {path.name for path in trained.iterdir()}
    assert {name for name in names if not re.fullmatch(r"checkpoint-\d{9}\.safetensors", name)} == FILES
    assert len(names) == len(FILES) + 1
    metrics = json.loads((trained / "metrics.json").read_text())
    assert set(metrics) >= METRICS
    assert all(isinstance(value, int | float) for value in metrics.values())
    assert metrics["parameters"] == (4 * 4 + 4) * 2 + (4 * 3 + 3) + (4 + 1)
    for figure in trained.glob("*.png"):
        assert figure.read_bytes().startswith(b"\x89PNG")
    config = json.loads((trained / "config.json").read_text())
    assert config["width"] == 4 and "out" not in config


def test_a_second_run_takes_the_next_folder_and_an_explicit_one_is_never_overwritten(trained, capsys):
    before = {path: path.read_bytes() for path in trained.iterdir()}
    line = refused(capsys, train_delan, *TINY, "--out", trained)
    assert "already contains a run" in line and "--resume" in line
    assert {path: path.read_bytes() for path in trained.iterdir()} == before


def test_a_finished_run_resumes_to_itself(trained):
    model = (trained / "model.safetensors").read_bytes()
    command(train_delan, "--out", trained, "--resume", "--no-figures", "--no-low-latency")
    assert (trained / "model.safetensors").read_bytes() == model


def test_resuming_with_other_settings_or_nothing_is_refused(trained, workplace, capsys):
    assert "started with width = 4" in refused(capsys, train_delan, "--out", trained, "--resume", "--width", "5")
    assert "holds none" in refused(capsys, train_delan, "--out", workplace / "void", "--resume")
    assert "holds none" in refused(capsys, train_delan, "--resume")
    assert not (workplace / "void").exists()


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_parameters(workplace):
    """SIGKILL after the first checkpoint, then --resume: the model equals an unbroken run's to the last bit."""
    settings = (
        "--optimizer",
        "adam",
        "--steps",
        "1200",
        "--width",
        "8",
        "--depth",
        "1",
        "--batch",
        "32",
        "--no-figures",
        "--no-low-latency",
        "--no-uncertainty",
        "--scene",
        "pendulum",
    )
    command(train_delan, *settings, "--out", "unbroken")
    process = subprocess.Popen(
        [sys.executable, "-m", "scripts.train_delan", *settings, "--out", str(workplace / "killed")],
        cwd=ROOT,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 120
    while not (workplace / "killed" / "checkpoint.json").exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (workplace / "killed" / "model.json").exists(), "the run was over before it could be killed"
    command(train_delan, "--out", "killed", "--resume", "--no-figures", "--no-low-latency")
    one, other = ((workplace / name / "model.safetensors").read_bytes() for name in ("unbroken", "killed"))
    assert one == other


@pytest.mark.slow
def test_a_file_of_ones_own_with_prismatic_joints_and_only_positions(workplace, capsys):
    data = generators.free_swing(cart_pole(), trajectories=4, steps=50)
    random = np.random.default_rng(0)
    np.savez(
        workplace / "mine.npz",
        t=data.t,
        q=data.q,
        tau=random.normal(size=data.q.shape),
        trajectory=data.trajectory,
    )
    needs = '{"joints": ["prismatic", "revolute"], "friction": true}'
    command(train_delan, "--data", "mine.npz", *TINY, "--needs", needs, "--no-uncertainty", "--out", "mine")
    out = capsys.readouterr().out
    assert "not in the data: qd, qdd" in out and "prismatic-revolute with gravity and friction (--needs)" in out
    metrics = json.loads((workplace / "mine" / "metrics.json").read_text())
    assert "torque_mse" in metrics and "inertial_mse" not in metrics
    state = np.zeros((3, 2))
    assert load(workplace / "mine").dynamics.inverse_dynamics(*state).dtype == jnp.float64


@pytest.mark.slow
def test_a_loss_that_explodes_keeps_the_last_good_model(workplace, capsys):
    settings = (*TINY, "--scene", "pendulum", "--learning-rate", "1e19", "--no-figures", "--no-uncertainty")
    line = refused(capsys, train_delan, *settings, "--out", "exploded")
    assert re.search(r"after step \d+", line) and "lower --learning-rate" in line
    tau = load("exploded").dynamics.inverse_dynamics(*np.ones((3, 1)))
    assert np.isfinite(tau).all()


@pytest.mark.slow
def test_out_of_time_is_a_run_that_has_learned_and_can_go_on_with_more(workplace, capsys):
    options = ("--optimizer", "adam", "--width", "3", "--depth", "1", *BRIEF, "--scene", "pendulum")
    folder = workplace / "late"
    command(train_delan, *options, "--steps", "400", "--seconds", "1e-6", "--out", folder)
    assert "out of time at step" in capsys.readouterr().out
    early = json.loads((folder / "metrics.json").read_text())
    assert 0 < early["best_step"] == early["steps"] < 400
    command(train_delan, "--out", folder, "--resume", *BRIEF, "--seconds", "2e-6")
    later = json.loads((folder / "metrics.json").read_text())
    assert later["steps"] == 2 * early["steps"]
    assert json.loads((folder / "config.json").read_text())["seconds"] == 2e-6


def arrays(**changes):
    data = {
        "t": np.tile(np.arange(4.0), 5),
        **{key: np.random.default_rng(0).normal(size=(20, 2)) for key in ("q", "qd", "qdd", "tau")},
        "trajectory": np.repeat(np.arange(5), 4),
        **changes,
    }
    return {key: value for key, value in data.items() if value is not None}


def marked(mark, size=1.0):
    """A mark for a missing value among numbers of this size."""
    return np.where(np.arange(40).reshape(20, 2) == 7, mark, size * np.random.default_rng(1).normal(size=(20, 2)))


MISTAKES = {
    "missing file": (None, [], "no such file"),
    "missing key": (arrays(q=None), [], "key 'q' is missing"),
    "not a number": (arrays(tau=np.full((20, 2), np.nan)), [], "tau has 40 NaN"),
    "shape": (arrays(qd=np.zeros((20, 3))), [], "qd has shape"),
    "no coordinates": (arrays(q=np.zeros((20, 0))), [], "d >= 1"),
    "one sample": ({key: value[:1] for key, value in arrays().items()}, [], "1 sample"),
    "unknown label": (arrays(), ["--test", "z"], "no trajectory is labelled 'z'"),
    "constant torque": (arrays(tau=np.zeros((20, 2))), [], "tau is constant"),
    "wrong scene": (arrays(), ["--scene", "pendulum"], "has 1 joints"),
    "unknown scene": (arrays(), ["--scene", "teapot"], "choose from two-link-arm"),
    "needs": (arrays(), ["--needs", "revolute"], "--needs is not JSON"),
    "activation": (arrays(), ["--activation", "sigmoidal"], "tanh"),
    "steps": (arrays(), ["--steps", "0"], "steps is 0"),
    "width": (arrays(), ["--width", "-1"], "width is -1"),
    "label without samples": (arrays(label=[*"abcdef"]), ["--test", "f"], "'f' has no samples"),
    "negative seed": (arrays(), ["--seed", "-1"], "seed is -1"),
    "large seed": (arrays(), ["--seed", "4294967295", "--seeds", "2"], "seed is 4294967295 and 1 after it"),
    "activation of adam": (arrays(), ["--activation", "sigmoidal", "--optimizer", "adam"], "tanh"),
    "mark for a missing torque": (arrays(tau=marked(1e308)), [], "tau has numbers of up to 1.0e+308"),
    "mark beyond single precision": (arrays(tau=marked(1e28, 1e10)), ["--optimizer", "adam"], "overflow in float32"),
    "mark for a missing rate": (arrays(qd=marked(1e40)), [], "qd has numbers of up to 1.0e+40 where half are below"),
    "mark whose square overflows": (arrays(qd=marked(1e120)), [], "qd has numbers of up to 1.0e+120, whose squares"),
    "mark for a missing rate of a network": (
        arrays(qd=marked(1e120)),
        ["--width", "4"],
        "qd has numbers of up to 1.0e+120, whose squares",
    ),
    "mark that has a square": (arrays(tau=marked(9.96921e36)), [], "up to 1.0e+37 where half are below"),
    "tiny torque": (arrays(tau=np.full((20, 2), 1e-170)), [], "squares vanish"),
    "degree": (arrays(), ["--degree", "2"], "--degree is an option of --model trigonometric"),
    "degree of a network": (
        arrays(),
        ["--model", "structured-delan", "--degree", "2"],
        "--degree is an option of --model trigonometric",
    ),
    "no torques": (arrays(tau=None), [], "python -m scripts.train_hnn_task --task measured --data"),
    "no times": (arrays(t=None), [], "give --rate HZ"),
    "rate beside times": (arrays(), ["--rate", "100"], "leave --rate out"),
    "units of an npz file": (arrays(), ["--units", "degrees"], "units are for CSV"),
    "one side of no energy": (
        arrays(),
        ["--model", "feed-forward", "--objective", "forward"],
        "feed-forward model has no energy",
    ),
    "objective of model selection": (
        arrays(),
        ["--model", "auto", "--objective", "both"],
        "--objective is an option of networks",
    ),
    "objective of a kernel": (
        arrays(),
        ["--model", "trigonometric-kernel", "--objective", "both"],
        "--objective is an option of networks",
    ),
    "batch": (arrays(), ["--batch", "64"], "--batch is an option of --optimizer adam"),
    "patience": (
        arrays(),
        ["--patience", "3", "--optimizer", "gauss-newton"],
        "--patience is an option of",
    ),
    "batch of adam": (arrays(), ["--batch", "-1", "--optimizer", "adam"], "batch is -1"),
    "rate": (arrays(), ["--learning-rate", "nan", "--optimizer", "adam"], "--learning-rate is nan"),
    "decay": (arrays(), ["--weight-decay", "inf", "--optimizer", "adam"], "--weight-decay is inf"),
    "seconds": (arrays(), ["--seconds", "nan"], "seconds is nan"),
    "negative seconds": (arrays(), ["--seconds", "-5"], "seconds is -5"),
    "width of a linear model": (
        arrays(),
        ["--model", "trigonometric", "--width", "4"],
        "--width is an option of",
    ),
    "optimizer of a linear model": (
        arrays(),
        ["--model", "trigonometric", "--optimizer", "adam"],
        "--optimizer is an option of",
    ),
    "seeds of a linear model": (
        arrays(),
        ["--model", "trigonometric", "--seeds", "2"],
        "--seeds is an option of",
    ),
    "width of a target": (arrays(), ["--target", "1", "--width", "4"], "--width is what --target grows"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing_behind(workplace, capsys, mistake):
    given, arguments, message = MISTAKES[mistake]
    path = workplace / "wrong.npz"
    path.unlink(missing_ok=True)
    if given is not None:
        np.savez(path, **given)
    assert message in refused(capsys, train_delan, "--data", path, "--out", workplace / "refused", *arguments)
    assert not (workplace / "refused").exists()


@pytest.mark.slow
def test_a_bare_recording_of_an_arm_with_friction_is_fitted_exactly_by_default(workplace, capsys):
    """One CSV file without t, trajectory and needs: two coupled joints, viscous and dry friction, springs."""
    random, T = np.random.default_rng(0), 400
    rate = random.uniform(1, 4, (2, 4))
    phase = rate * (0.02 * np.arange(T))[:, None, None] + random.uniform(0, 6, (2, 4))
    q, qd, qdd = np.sin(phase).sum(2), (rate * np.cos(phase)).sum(2), -(rate**2 * np.sin(phase)).sum(2)
    inertia = 0.3 * np.cos(q[:, 0] - q[:, 1])
    torque = np.stack([2 * qdd[:, 0] + inertia * qdd[:, 1], inertia * qdd[:, 0] + qdd[:, 1]], axis=1)
    # d/dt of the off-diagonal term of M, and its part in dT/dq.
    slope = -0.3 * np.sin(q[:, 0] - q[:, 1])
    torque += np.stack([-slope * qd[:, 1] ** 2, slope * qd[:, 0] ** 2], axis=1)
    torque += 3 * np.sin(q) + 0.4 * qd + 0.2 * np.tanh(qd / 0.01)
    titles = [f"{key}{joint} [{unit}]" for key, unit in KINDS.items() for joint in (1, 2)]
    rows = np.hstack([np.degrees(q), np.degrees(qd), qdd, 1e3 * torque])
    np.savetxt("bare.csv", rows, delimiter=",", header=",".join(titles), comments="")
    command(train_delan, "--data", "bare.csv", "--rate", "50", *BRIEF, "--out", "bare")
    said = capsys.readouterr().out
    assert "one recording: cut into blocks of time" in said and "friction of joints: viscous, coulomb, offset" in said
    assert "verdict: good" in said and "trigonometric is exact" in said
    metrics = json.loads((workplace / "bare" / "metrics.json").read_text())
    assert metrics["torque_mse"] < 1e-18 and metrics["verdict"] == 0 and metrics["validation_nmse"] < 1e-18
    config = json.loads((workplace / "bare" / "config.json").read_text())
    assert (config["model"], config["rate"]) == ("auto", 50) and len(config["chosen"]["validation_units"]) == 2
    stored = json.loads((workplace / "bare" / "model_selection.json").read_text())
    assert stored["kept"] == "trigonometric" == load(workplace / "bare").description["name"]
    assert len(stored["candidates"][0]["validation_nmse_joints"]) == 2 and stored["ended"] == "trigonometric is exact"


def test_a_model_that_is_worse_than_a_constant_is_refused_in_words(workplace, capsys):
    random = np.random.default_rng(0)
    noise = {key: random.normal(size=(60, 1)) for key in ("q", "qd", "qdd", "tau")}
    np.savez("noise.npz", t=np.tile(np.arange(10.0), 6), trajectory=np.repeat(np.arange(6), 10), **noise)
    options = ("--data", "noise.npz", "--model", "trigonometric", "--degree", "2", *BRIEF)
    with pytest.raises(SystemExit) as stop:
        command(train_delan, *options, "--out", "noise")
    said = capsys.readouterr()
    assert stop.value.code == 1 and said.err.startswith("error: the fit is refused: the torque of joint 1 is predicted")
    assert json.loads((workplace / "noise" / "metrics.json").read_text())["verdict"] == 2


@pytest.mark.slow
def test_a_cart_that_is_driven_alone_is_trained(workplace, capsys):
    """The torque of its pole is zero in every sample."""
    data = generators.uniform(cart_pole(), samples=80, rate_bound=2.0, acceleration_bound=5.0)
    tau = data.tau * [1.0, 0.0]
    qdd = np.asarray(jax.vmap(dynamics(cart_pole().energies).forward_dynamics)(data.q, data.qd, tau))
    np.savez("cart.npz", t=np.arange(80.0), q=data.q, qd=data.qd, qdd=qdd, tau=tau, trajectory=np.arange(80) // 10)
    # Times are not those of a motion, so that the file's rates contradict q: this is only said.
    needs = '{"joints": ["prismatic", "revolute"]}'
    command(train_delan, "--data", "cart.npz", "--needs", needs, "--model", "trigonometric", *BRIEF, "--out", "cart")
    assert json.loads((workplace / "cart" / "metrics.json").read_text())["torque_mse"] < 1e-16


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene, options",
    [
        (cart_pole(friction=0.2), ("structured-delan", *TINY[:7])),
        (cart_pole(friction=0.2), ("trigonometric", "--degree", "1")),
        pytest.param(chain(2), ("learned-tree", "--seconds", "60"), marks=pytest.mark.slow),
    ],
    ids=["network", "least-squares", "tree"],
)
def test_both_errors_are_fitted_together_on_request(workplace, capsys, scene, options):
    data = generators.uniform(scene, samples=60, rate_bound=2.0, acceleration_bound=5.0)
    noisy = data._replace(tau=data.tau + [0.1, 0.0] * np.random.default_rng(0).normal(size=data.tau.shape))
    schema.save("noisy.npz", noisy, overwrite=True)
    out = workplace / f"both-{options[0]}"
    command(train_delan, "--data", "noisy.npz", "--model", *options, *BRIEF, "--objective", "both", "--out", out)
    said = capsys.readouterr().out
    assert ("refined by both sides' errors" in said) == (options[0] != "structured-delan")
    assert json.loads((out / "config.json").read_text())["objective"] == "both"
    assert np.isfinite(json.loads((out / "metrics.json").read_text())["forward_mse"])


def test_data_are_made_read_back_and_never_overwritten_unasked(workplace, capsys):
    made = ("--scene", "chain-3", "--kind", "uniform", "--samples", "20")
    command(make_data, *made, "--out", "chain.npz")
    assert "20 samples of 20 trajectories, 3 degrees of freedom" in capsys.readouterr().out
    assert schema.load("chain.npz").degrees_of_freedom == 3
    assert "exists" in refused(capsys, make_data, *made, "--out", "chain.npz")
    command(make_data, *made, "--out", "chain.npz", "--overwrite")
    assert "choose another --kind" in refused(capsys, make_data, "--scene", "chain-3", "--out", "letters.npz")
    assert "samples is 0" in refused(capsys, make_data, *made[:-1], "0", "--out", "none.npz")
    assert not Path("none.npz").exists()
