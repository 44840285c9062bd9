"""Numbers that no run can have are refused before anything is allocated or written, in one line."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from calls import command, json_of, one_line, refused

from dln_jax.cli.arguments import arguments_of
from dln_jax.cli.commands import (
    check_data,
    excite,
    export_c,
    make_data,
    simulate,
    sweep,
    train_delan,
    train_diffnet,
    train_hnn,
    train_hnn_task,
    train_locomotion,
    train_value,
)
from dln_jax.cli.stored_arguments import with_stored_arguments, write_config
from dln_jax.training.values import Family, family_of, load_value, plant_named, save_value
from dln_jax.types import InputError
from scripts.reports.commands import (
    arm_table,
    benchmark,
    compare_locomotion,
    diffnet_report,
    diffnet_table,
    hnn_table,
    scale_report,
    softbody_report,
)

ROBOT = """<robot name="r"><link name="b"/><link name="l"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><joint name="j" type="revolute">
<parent link="b"/><child link="l"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="3"/></joint>
</robot>"""
DIGITS = "9" * 5000
WIDE, DEEP = "--width 1000000000", "--depth 5000"
OPTIONS = {
    make_data: [
        *(
            f"--scene pendulum --kind uniform --{bound}"
            for bound in ("position-bound inf", "rate-bound nan", "seed -1", "samples 10000000000", "samples 1")
        ),
        *(
            f"--scene pendulum --kind free-swing --{bound}"
            for bound in ("seed -1", "dt inf", "trajectories 1000000000", "steps 99999999")
        ),
        "--dt inf",
    ],
    train_delan: [
        *(WIDE, f"--width {DIGITS}", "--devices 1000000", f"--processes {DIGITS}"),
        *("--steps 1000000000000", "--seeds 1000000000", "--seed -1"),
        *("--data data.npz --depth 5000", "--data data.npz --optimizer adam --learning-rate inf"),
    ],
    train_hnn: [WIDE, "--data data.npz --depth 5000"],
    train_hnn_task: [WIDE, "--task measured --data free.npz --depth 5000"],
    train_diffnet: [WIDE, DEEP, "--samples 1000000000", "--samples 1", "--noise inf"],
    train_value: [WIDE, "--members 1000000000", "--starts 1000000000"],
    train_locomotion: ["--upright inf"],
    simulate: [
        *("--cells 100000", "--cells 9000", "--seconds 1e30", "--seconds 1e308", "--dt 1e-320"),
        *("--youngs-modulus inf", "--scene teapot"),
    ],
    excite: [
        f"--robot r.urdf --{bound}"
        for bound in (
            *("noise 1,2,3", "noise little", "noise 0", "position 1e308", "payload-position 1,2,3"),
            *("criterion beauty", "rate 1e30"),
        )
    ],
    check_data: [f"--data data.npz --robot {'x' * 5000}"],
    export_c: ["--run nothing", f"--run {'x' * 5000}"],
    sweep: [
        *(f"--grid seed=0:{DIGITS}", f"--grid width=8,{DIGITS}"),
        *("--grid width=2 --where here --slurm time=5", "--grid width=2 --where later --slurm many"),
    ],
    arm_table: ["--adam-steps -1"],
    scale_report: [f"--lanes {DIGITS}"],
    diffnet_table: ["--samples 1"],
    diffnet_report: [DEEP],
    compare_locomotion: ["--upright inf", "--rivals ppo,dreams"],
    softbody_report: ["--only teapot"],
    hnn_table: ["--tasks spring,teapot"],
}
"""Numbers and names that no run can have, by command."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Path("r.urdf").write_text(ROBOT)
    random = np.random.default_rng(0)
    data = {key: random.normal(size=(20, 1)) for key in ("q", "qd", "qdd")}
    data |= {"t": np.tile(np.arange(4.0), 5), "trajectory": np.repeat(np.arange(5), 4)}
    np.savez("data.npz", tau=random.normal(size=(20, 1)), **data)
    np.savez("free.npz", **data)
    return tmp_path


@pytest.mark.parametrize("script", OPTIONS, ids=lambda script: script.__name__.rpartition(".")[2])
def test_what_is_out_of_bounds_is_refused(here, capsys, script):
    before = sorted(here.rglob("*"))
    for options in OPTIONS[script]:
        line = refused(capsys, script, options, "--out", "new.npz" if script is make_data else "new")
        assert len(line) < 1200
        assert [path for path in sorted(here.rglob("*")) if here / "cache" not in (path, *path.parents)] == before


def test_messages_say_what_was_given_and_what_was_expected(here, capsys):
    Path("full").mkdir()
    Path("full/notes.txt").touch()
    for script, options, words in (
        (train_delan, "--steps many", "--steps must be a whole number; got 'many'"),
        (simulate, "--dt soon", "--dt must be a number; got 'soon'"),
        (benchmark, "--out full c", "already contains files; choose another --out\n"),
        (train_diffnet, "--samples 20 --out full", "already contains files; choose another --out\n"),
        (check_data, "--data data.npz --robot none.urdf", "none.urdf: no such file; give the URDF or MJCF"),
    ):
        assert words in refused(capsys, script, options)
    # One line whatever the name.
    assert "two\\nlines\\x1b[31m" in refused(capsys, export_c, "--run", "two\nlines\x1b[31m", "--out c")


@pytest.mark.parametrize(("still", "robot"), [(0.0, False), (5.0, True), (1e-300, False), (1e-300, True)])
def test_a_joint_whose_torque_stays_the_same_is_examined(here, still, robot):
    """As that of every cart-pole, which is driven at its cart alone."""
    t = np.arange(0.0, 2.0, 0.01)
    q = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    qd = np.stack([3 * np.cos(3 * t), -2 * np.sin(2 * t)], axis=1)
    qdd = -q * [9.0, 4.0]
    tau = np.stack([qdd[:, 0] + 0.3 * qdd[:, 1], np.full(len(t), still)], axis=1)
    np.savez("log.npz", t=t, q=q, qd=qd, qdd=qdd, tau=tau, trajectory=np.zeros(len(t), int))
    two = ROBOT.replace("</robot>", "") + ROBOT[ROBOT.index('<link name="l">') :].replace('"l"', '"m"').replace(
        '"j"', '"k"'
    ).replace('parent link="b"', 'parent link="l"')
    Path("two.urdf").write_text(two)
    command(check_data, "--data log.npz", *["--robot", "two.urdf"] * robot, "--out page --no-figures")
    assert json.loads(Path("page/metrics.json").read_text())


VALUES = {
    "plant": [3, None, "teapot"],
    "goal": ["x", ["a"], [[1]], {"a": 1}, [None], [1.0, 2.0, 3.0]],
    "dtype": [[], {}, "int32", None],
    "network": [None, [], {}, {"widths": [4]}],
    "tensors": [None, 3, [], {"a": 1}, {"a": {"shape": [-1]}}, {"a": {"shape": ["x"]}}],
}


def test_damaged_value_functions_are_refused(tmp_path):
    plant, family = plant_named("pendulum"), Family((4,), 1)
    parameters = family_of(plant, family).init(jax.random.key(0))
    save_value(tmp_path, "pendulum", None, family, parameters)
    path = tmp_path / "value.json"
    stored = json_of(path)
    load_value(tmp_path)
    network = {name: {**stored["network"], name: "x"} for name in stored["network"]}
    changes = [{key: value} for key, values in VALUES.items() for value in values]
    for change in [*changes, *({"network": each} for each in network.values())]:
        path.write_text(json.dumps({**stored, **change}))
        with one_line():
            load_value(tmp_path)


# folders that have moved


def interrupted_run(folder):
    """The folder of a run that was started with data.npz, and got no further."""
    (folder / "run").mkdir()
    given = arguments_of(train_delan.Arguments, data=Path("data.npz"), out=folder / "run")
    write_config(folder / "run", given)
    return type(given)(out=Path("run"), resume=True)


def test_a_run_is_resumed_where_its_data_have_moved(here, monkeypatch):
    """By their new path; where they are where they were, relative to where the command is called, by none."""
    asked = interrupted_run(here)
    assert with_stored_arguments(asked, train_delan.Arguments).data == Path("data.npz")
    moved = here / "moved"
    moved.mkdir()
    (here / "run").rename(moved / "run")
    monkeypatch.chdir(moved)
    with pytest.raises(InputError, match=r"data\.npz, which is not here; give its new path by --data"):
        with_stored_arguments(asked, train_delan.Arguments)
    for path in (Path("../data.npz"), here / "data.npz"):
        assert with_stored_arguments(dataclasses.replace(asked, data=path), train_delan.Arguments).data == path
    np.savez("other.npz", **{**np.load(here / "data.npz"), "t": np.arange(20.0)})
    with pytest.raises(InputError, match="started with other data"):
        with_stored_arguments(dataclasses.replace(asked, data=Path("other.npz")), train_delan.Arguments)


# processes

ROOT = Path(__file__).parents[3]


def environment(folder):
    return {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONUNBUFFERED": "1"}


@pytest.mark.slow
def test_closed_and_full_outputs_end_quietly(here):
    """With the help of a command, and its mistakes: the interpreter must not complain about them as it ends."""
    shell = f"{sys.executable} -m scripts.make_data"
    for line, codes in (
        (f"{shell} --out a.npz --samples x >&-", {2}),
        (f"{shell} --help | true; exit ${{PIPESTATUS[0]}}", {0, 141}),
        (f"{shell} --help >/dev/full", {2}),
    ):
        done = subprocess.run(["bash", "-c", line], env=environment(here), capture_output=True, text=True, timeout=120)
        assert done.returncode in codes, done.stderr
        assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
        assert done.stderr.count("\n") <= 1


def test_sigterm_ends_a_training_with_a_checkpoint_and_the_command_that_continues_it(here):
    line = [sys.executable, "-m", "scripts.train_diffnet", "--samples", "2000", "--epochs", "300", "--width", "8"]
    line += ["--optimizer", "adam", "--no-figures"]
    process = subprocess.Popen([*line, "--out", "run"], env=environment(here), stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 120
    while not Path("run/checkpoint.json").is_file() and not list(Path(".").glob("run/checkpoint*.json")):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == "interrupted; continue with: python -m scripts.train_diffnet --out run --resume\n"
    assert json.loads(next(Path("run").glob("checkpoint*.json")).read_text())["history"]
