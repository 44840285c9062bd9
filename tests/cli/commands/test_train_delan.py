"""The command line end to end on a tiny budget: what it writes, what it refuses, and how it survives a kill."""

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
from calls import assert_refused, command, exit_status, json_of, refused

from dln_jax.cli.commands import make_data, train_delan
from dln_jax.data import schema
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import chain
from dln_jax.scenes.poles import cart_pole
from dln_jax.zoo.run import load

ROOT = Path(__file__).parents[3]
TINY = "--optimizer adam --steps 40 --batch 64 --width 4 --depth 1 --precision f64 --no-low-latency"
BRIEF = "--no-figures --no-low-latency --no-uncertainty"
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
    command(train_delan, TINY)
    return workplace / "runs" / "train_delan-1"


def test_a_run_writes_all_its_files(trained):
    names = {path.name for path in trained.iterdir()}
    assert {name for name in names if not re.fullmatch(r"checkpoint-\d{9}\.safetensors", name)} == FILES
    assert len(names) == len(FILES) + 1
    metrics = json_of(trained / "metrics.json")
    assert set(metrics) >= METRICS
    assert all(isinstance(value, int | float) for value in metrics.values())
    assert metrics["parameters"] == (4 * 4 + 4) * 2 + (4 * 3 + 3) + (4 + 1)
    for figure in trained.glob("*.png"):
        assert figure.read_bytes().startswith(b"\x89PNG")
    config = json_of(trained / "config.json")
    assert config["width"] == 4 and "out" not in config


def test_a_second_run_takes_the_next_folder_and_an_explicit_one_is_never_overwritten(trained, capsys):
    before = {path: path.read_bytes() for path in trained.iterdir()}
    line = refused(capsys, train_delan, TINY, "--out", trained)
    assert "already contains a run" in line and "--resume" in line
    assert {path: path.read_bytes() for path in trained.iterdir()} == before


def test_a_finished_run_resumes_to_itself(trained):
    model = (trained / "model.safetensors").read_bytes()
    command(train_delan, "--out", trained, "--resume --no-figures --no-low-latency")
    assert (trained / "model.safetensors").read_bytes() == model


def test_resuming_with_other_settings_or_nothing_is_refused(trained, workplace, capsys):
    assert "started with width = 4" in refused(capsys, train_delan, "--out", trained, "--resume --width 5")
    assert "holds none" in refused(capsys, train_delan, "--out", workplace / "void", "--resume")
    assert "holds none" in refused(capsys, train_delan, "--resume")
    assert not (workplace / "void").exists()


@pytest.mark.slow
def test_a_killed_run_resumes_to_the_same_parameters(workplace):
    """SIGKILL after the first checkpoint, then --resume: the model equals an unbroken run's to the last bit."""
    settings = f"--optimizer adam --steps 1200 --width 8 --depth 1 --batch 32 {BRIEF} --scene pendulum"
    command(train_delan, settings, "--out unbroken")
    process = subprocess.Popen(
        [sys.executable, "-m", "scripts.train_delan", *settings.split(), "--out", str(workplace / "killed")],
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
    command(train_delan, "--out killed --resume --no-figures --no-low-latency")
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
    command(train_delan, "--data mine.npz --no-uncertainty --out mine", TINY, "--needs", needs)
    out = capsys.readouterr().out
    assert "not in the data: qd, qdd" in out and "prismatic-revolute with gravity and friction (--needs)" in out
    metrics = json_of(workplace / "mine" / "metrics.json")
    assert "torque_mse" in metrics and "inertial_mse" not in metrics
    state = np.zeros((3, 2))
    assert load(workplace / "mine").dynamics.inverse_dynamics(*state).dtype == jnp.float64


@pytest.mark.slow
def test_a_loss_that_explodes_keeps_the_last_good_model(workplace, capsys):
    line = refused(capsys, train_delan, TINY, "--scene pendulum --learning-rate 1e19", BRIEF, "--out exploded")
    assert re.search(r"after step \d+", line) and "lower --learning-rate" in line
    tau = load("exploded").dynamics.inverse_dynamics(*np.ones((3, 1)))
    assert np.isfinite(tau).all()


@pytest.mark.slow
def test_out_of_time_is_a_run_that_has_learned_and_can_go_on_with_more(workplace, capsys):
    folder = workplace / "late"
    options = f"--optimizer adam --width 3 --depth 1 {BRIEF} --scene pendulum --steps 400 --seconds 1e-6"
    command(train_delan, options, "--out", folder)
    assert "out of time at step" in capsys.readouterr().out
    early = json_of(folder / "metrics.json")
    assert 0 < early["best_step"] == early["steps"] < 400
    command(train_delan, "--out", folder, "--resume --seconds 2e-6", BRIEF)
    later = json_of(folder / "metrics.json")
    assert later["steps"] == 2 * early["steps"]
    assert json_of(folder / "config.json")["seconds"] == 2e-6


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


WRONG_DATA = [
    (arrays(q=None), "key 'q' is missing"),
    (arrays(tau=np.zeros((20, 2))), "tau is constant"),
    (arrays(label=[*"abcdef"]), "--test f", "'f' has no samples"),
    (arrays(tau=None), "python -m scripts.train_hnn_task --task measured --data"),
    (arrays(t=None), "give --rate HZ"),
    # Marks for missing values.
    (arrays(tau=marked(1e308)), "tau has numbers of up to 1.0e+308"),
    (arrays(tau=marked(1e28, 1e10)), "--optimizer adam", "overflow in float32"),
    (arrays(qd=marked(1e40)), "qd has numbers of up to 1.0e+40 where half are below"),
    (arrays(qd=marked(1e120)), "qd has numbers of up to 1.0e+120, whose squares"),
    (arrays(qd=marked(1e120)), "--width 4", "qd has numbers of up to 1.0e+120, whose squares"),
    (arrays(tau=marked(9.96921e36)), "up to 1.0e+37 where half are below"),
    (arrays(tau=np.full((20, 2), 1e-170)), "squares vanish"),
]
MISTAKES = [
    ("--data none.npz", "no such file"),
    ("--test z", "no trajectory is labelled 'z'"),
    ("--scene pendulum", "has 1 joints"),
    ("--scene teapot", "choose from two-link-arm"),
    ("--needs revolute", "--needs is not JSON"),
    ("--activation sigmoidal", "tanh"),
    ("--activation sigmoidal --optimizer adam", "tanh"),
    ("--steps 0", "steps is 0"),
    ("--width -1", "width is -1"),
    ("--seed -1", "seed is -1"),
    ("--seed 4294967295 --seeds 2", "seed is 4294967295 and 1 after it"),
    ("--degree 2", "--degree is an option of --model trigonometric"),
    ("--model structured-delan --degree 2", "--degree is an option of --model trigonometric"),
    ("--rate 100", "leave --rate out"),
    ("--units degrees", "units are for CSV"),
    ("--model feed-forward --objective forward", "feed-forward model has no energy"),
    ("--model auto --objective both", "--objective is an option of networks"),
    ("--model trigonometric-kernel --objective both", "--objective is an option of networks"),
    ("--batch 64", "--batch is an option of --optimizer adam"),
    ("--patience 3 --optimizer gauss-newton", "--patience is an option of"),
    ("--batch -1 --optimizer adam", "batch is -1"),
    ("--learning-rate nan --optimizer adam", "--learning-rate is nan"),
    ("--weight-decay inf --optimizer adam", "--weight-decay is inf"),
    ("--seconds nan", "seconds is nan"),
    ("--seconds -5", "seconds is -5"),
    ("--model trigonometric --width 4", "--width is an option of"),
    ("--model trigonometric --optimizer adam", "--optimizer is an option of"),
    ("--model trigonometric --seeds 2", "--seeds is an option of"),
    ("--target 1 --width 4", "--width is what --target grows"),
]


def test_mistakes_are_one_line_and_leave_nothing_behind(workplace, capsys):
    path, out = workplace / "wrong.npz", workplace / "refused"
    for given, *row in WRONG_DATA:
        np.savez(path, **given)
        assert_refused(capsys, train_delan, [row], "--data", path, out=out)
    np.savez(path, **arrays())
    assert_refused(capsys, train_delan, MISTAKES, "--data", path, out=out)


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
    command(train_delan, "--data bare.csv --rate 50 --out bare", BRIEF)
    said = capsys.readouterr().out
    assert "one recording: cut into blocks of time" in said and "friction of joints: viscous, coulomb, offset" in said
    assert "verdict: good" in said and "trigonometric is exact" in said
    metrics = json_of(workplace / "bare" / "metrics.json")
    assert metrics["torque_mse"] < 1e-18 and metrics["verdict"] == 0 and metrics["validation_nmse"] < 1e-18
    config = json_of(workplace / "bare" / "config.json")
    assert (config["model"], config["rate"]) == ("auto", 50) and len(config["chosen"]["validation_units"]) == 2
    stored = json_of(workplace / "bare" / "model_selection.json")
    assert stored["kept"] == "trigonometric" == load(workplace / "bare").description["name"]
    assert len(stored["candidates"][0]["validation_nmse_joints"]) == 2 and stored["ended"] == "trigonometric is exact"


def test_a_model_that_is_worse_than_a_constant_is_refused_in_words(workplace, capsys):
    random = np.random.default_rng(0)
    noise = {key: random.normal(size=(60, 1)) for key in ("q", "qd", "qdd", "tau")}
    np.savez("noise.npz", t=np.tile(np.arange(10.0), 6), trajectory=np.repeat(np.arange(6), 10), **noise)
    options = ("--data", "noise.npz", "--model", "trigonometric", "--degree", "2", BRIEF)
    status = exit_status(train_delan, *options, "--out noise")
    said = capsys.readouterr()
    assert status == 1 and said.err.startswith("error: the fit is refused: the torque of joint 1 is predicted")
    assert json_of(workplace / "noise" / "metrics.json")["verdict"] == 2


@pytest.mark.slow
def test_a_cart_that_is_driven_alone_is_trained(workplace, capsys):
    """The torque of its pole is zero in every sample."""
    data = generators.uniform(cart_pole(), samples=80, rate_bound=2.0, acceleration_bound=5.0)
    tau = data.tau * [1.0, 0.0]
    qdd = np.asarray(jax.vmap(dynamics(cart_pole().energies).forward_dynamics)(data.q, data.qd, tau))
    np.savez("cart.npz", t=np.arange(80.0), q=data.q, qd=data.qd, qdd=qdd, tau=tau, trajectory=np.arange(80) // 10)
    # Times are not those of a motion, so that the file's rates contradict q: this is only said.
    needs = '{"joints": ["prismatic", "revolute"]}'
    command(train_delan, "--data cart.npz --model trigonometric --out cart", BRIEF, "--needs", needs)
    assert json_of(workplace / "cart" / "metrics.json")["torque_mse"] < 1e-16


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene, options",
    [
        (cart_pole(friction=0.2), f"--model structured-delan {TINY}"),
        (cart_pole(friction=0.2), "--model trigonometric --degree 1"),
        (chain(2), "--model learned-tree --seconds 60"),
    ],
    ids=["network", "least-squares", "tree"],
)
def test_both_errors_are_fitted_together_on_request(workplace, capsys, scene, options):
    data = generators.uniform(scene, samples=60, rate_bound=2.0, acceleration_bound=5.0)
    noisy = data._replace(tau=data.tau + [0.1, 0.0] * np.random.default_rng(0).normal(size=data.tau.shape))
    schema.save("noisy.npz", noisy, overwrite=True)
    out = workplace / f"both-{options.split()[1]}"
    command(train_delan, "--data noisy.npz --objective both", options, BRIEF, "--out", out)
    said = capsys.readouterr().out
    assert ("refined by both sides' errors" in said) == ("structured-delan" not in options)
    assert json_of(out / "config.json")["objective"] == "both"
    assert np.isfinite(json_of(out / "metrics.json")["forward_mse"])


def test_data_are_made_read_back_and_never_overwritten_unasked(workplace, capsys):
    made = "--scene chain-3 --kind uniform --samples 20"
    command(make_data, made, "--out chain.npz")
    assert "20 samples of 20 trajectories, 3 degrees of freedom" in capsys.readouterr().out
    assert schema.load("chain.npz").degrees_of_freedom == 3
    assert "exists" in refused(capsys, make_data, made, "--out chain.npz")
    command(make_data, made, "--out chain.npz --overwrite")
    assert "choose another --kind" in refused(capsys, make_data, "--scene chain-3 --out letters.npz")
    assert "samples is 0" in refused(capsys, make_data, made, "--samples 0 --out none.npz")
    assert not Path("none.npz").exists()
