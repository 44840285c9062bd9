"""Numbers that no run can have are refused before anything is allocated or written, in one line."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from calls import command, json_of, one_line, refused
from planar_arm import motions
from small_logs import small_log

from dln_jax.commands import (
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
from dln_jax.commands.values import plants
from dln_jax.data import schema
from dln_jax.runs.arguments import arguments_of
from dln_jax.runs.folder import with_stored_arguments, write_config
from dln_jax.zoo.run import load, save
from dln_jax.zoo.value_functions import network_of, plant_of_model, save_value

ROBOT = """<robot name="r"><link name="b"/><link name="l"><inertial><mass value="1"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link><joint name="j" type="revolute">
<parent link="b"/><child link="l"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="9" velocity="3"/></joint>
</robot>"""
DIGITS = "9" * 5000
OPTIONS = {
    make_data: [
        "--scene pendulum --kind uniform --seed -1",
        "--scene pendulum --kind uniform --samples 10000000000",
        "--scene pendulum --kind free-swing --dt inf",
        "--scene pendulum --kind free-swing --trajectories 1000000000",
        "--scene pendulum --kind free-swing --steps 99999999",
    ],
    train_delan: [
        *("--width 1000000000", f"--width {DIGITS}", "--devices 1000000", f"--processes {DIGITS}"),
        *("--steps 1000000000000", "--seeds 1000000000", "--data data.npz --depth 5000"),
        "--data data.npz --optimizer adam --learning-rate inf",
    ],
    train_hnn: ["--width 1000000000", "--data data.npz --depth 5000"],
    train_hnn_task: ["--width 1000000000", "--task measured --data free.npz --depth 5000"],
    train_diffnet: ["--width 1000000000", "--depth 5000", "--samples 1000000000", "--samples 1"],
    train_value: ["--width 1000000000", "--members 1000000000", "--starts 1000000000"],
    train_locomotion: ["--upright inf"],
    simulate: [
        *("--cells 100000", "--cells 9000", "--seconds 1e30", "--seconds 1e308", "--dt 1e-320"),
        "--youngs-modulus inf",
    ],
    excite: [
        *("--robot r.urdf --noise 1,2,3", "--robot r.urdf --noise little", "--robot r.urdf --noise 0"),
        *("--robot r.urdf --position 1e308", "--robot r.urdf --payload-position 1,2,3", "--robot r.urdf --rate 1e30"),
    ],
    check_data: [f"--data data.npz --robot {'x' * 5000}"],
    export_c: ["--run nothing", f"--run {'x' * 5000}"],
    sweep: [
        *(f"--grid seed=0:{DIGITS}", f"--grid width=8,{DIGITS}"),
        *("--grid width=2 --where here --slurm time=5", "--grid width=2 --where later --slurm many"),
    ],
}
"""Numbers and names that no run can have, by command."""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Path("r.urdf").write_text(ROBOT)
    data = small_log(1)
    np.savez("data.npz", **data)
    del data["tau"]
    np.savez("free.npz", **data)
    return tmp_path


def test_what_is_out_of_bounds_is_refused(here, capsys):
    before = sorted(here.iterdir())
    for script, rows in OPTIONS.items():
        for options in rows:
            line = refused(capsys, script, options, "--out", "new.npz" if script is make_data else "new")
            assert len(line) < 1200
            assert [path for path in sorted(here.iterdir()) if path.name != "cache"] == before, options


def test_messages_are_one_line_whatever_the_name(here, capsys):
    line = refused(capsys, check_data, "--data data.npz --robot none.urdf")
    assert "none.urdf: no such file; give the URDF or MJCF" in line
    assert "two\\nlines\\x1b[31m" in refused(capsys, export_c, "--run", "two\nlines\x1b[31m", "--out c")


def test_a_joint_whose_torque_stays_the_same_is_examined(here):
    """As that of every cart-pole, which is driven at its cart alone."""
    log = motions(0, friction=False)
    for still in (0.0, 5.0, 1e-300):
        schema.save("log.npz", log._replace(tau=log.tau * [1, 0] + [0, still]), overwrite=True)
        command(check_data, "--data log.npz --no-figures --out", f"page{still}")


VALUES = [
    *(
        '{"plant": 3}',
        '{"own": null}',
        '{"own": {}}',
        '{"dtype": []}',
        '{"dtype": "int32"}',
        '{"network": null}',
        '{"network": []}',
        '{"network": {"widths": [4]}}',
    ),
    *('{"tensors": 3}', '{"tensors": {"a": 1}}', '{"tensors": {"a": {"shape": [-1]}}}'),
    '{"tensors": {"a": {"shape": ["x"]}}}',
]


def test_damaged_value_functions_are_refused(tmp_path):
    settings = {"widths": [4], "members": 1, "activation": "tanh", "floor": 1e-3, "scale": 30.0}
    known, layout, _ = plants.of_file(plants.file_of("pendulum"))
    own = plants.problem_of(known, layout)
    network = network_of(plant_of_model(known.model, known.parameters, own), settings)
    save(tmp_path, known.description, known.parameters)
    save_value(tmp_path, "pendulum", settings, network.init(jax.random.key(0)), own)
    path = tmp_path / "value.json"
    stored = json_of(path)
    load(tmp_path)
    networks = [{"network": {**stored["network"], name: "x"}} for name in stored["network"]]
    short = [
        {"own": {**stored["own"], name: value[:-1]}} for name, value in stored["own"].items() if isinstance(value, list)
    ]
    for change in [*map(json.loads, VALUES), *networks, *short]:
        path.write_text(json.dumps({**stored, **change}))
        with one_line():
            load(tmp_path)


# folders that have moved


@pytest.mark.parametrize("data", ["log", "log/part"], ids=["file", "folder"])
def test_a_run_is_resumed_where_its_data_have_moved(here, monkeypatch, data):
    """By their new path; where they are where they were, relative to where the command is called, by none.

    Data may be a folder, such as a ROS bag.
    """

    def resumed(**moved):
        asked = type(given)(out=Path("run"), resume=True, **moved)
        return with_stored_arguments(asked, train_delan.Arguments).data

    file = here / data
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(b"states")
    given = arguments_of(train_delan.Arguments, data=Path("log"), out=Path("run"))
    (here / "moved/run").mkdir(parents=True)
    write_config(here / "moved/run", given)
    Path("run").symlink_to("moved/run")
    assert resumed() == Path("log")
    monkeypatch.chdir("moved")
    with one_line("log, which does not exist; give its new path with --data"):
        resumed()
    assert resumed(data=Path("../log")) == Path("../log")
    file.write_bytes(b"stated")
    with one_line("data in .*log have changed"):
        resumed(data=Path("../log"))


# processes


def test_sigterm_ends_a_training_with_a_checkpoint_and_the_command_that_continues_it(here):
    options = "--samples 2000 --epochs 300 --width 8 --optimizer adam --no-figures --out run"
    line = [sys.executable, "-m", "scripts.train_diffnet", *options.split()]
    told = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    with subprocess.Popen(line, env=told, stderr=subprocess.PIPE, text=True) as process:
        until = time.monotonic() + 120
        while not list(Path("run").glob("checkpoint*.json")):
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        process.terminate()
        said = process.stderr.read()
    assert process.returncode == 130
    assert said == "interrupted; continue with: python -m scripts.train_diffnet --out run --resume\n"
    (checkpoint,) = Path("run").glob("checkpoint*.json")
    assert json_of(checkpoint)["history"]
