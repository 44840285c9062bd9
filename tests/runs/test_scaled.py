"""Options for devices and processes, as far as one process can tell."""

import jax
from calls import refused

from dln_jax.commands import train_delan, train_diffnet, train_hnn, train_locomotion, train_value
from dln_jax.options import Scaled
from dln_jax.runs.arguments import arguments_for, arguments_of
from dln_jax.runs.devices import mesh_of
from dln_jax.runs.folder import stored_arguments

TOGETHER = "--processes 2 --coordinator 127.0.0.1:61440 --process-id 1"


def test_commands_that_several_processes_share_say_so():
    commands = (train_delan, train_hnn, train_diffnet, train_locomotion, train_value)
    assert all(issubclass(arguments_for(command.Arguments, {}), Scaled) for command in commands)
    # A run does not remember where it was computed.
    there = arguments_of(train_diffnet.Arguments, devices=4, processes=2, coordinator="node1:61440", process_id=1)
    assert stored_arguments(there) == stored_arguments(arguments_of(train_diffnet.Arguments))


def test_mistakes_are_one_line(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    jax.devices()
    for options, message in {
        TOGETHER: "need --out",
        "--processes 2": "--coordinator and --process-id missing",
        "--processes 0": "expected a positive whole number",
        "--devices 0": "--devices is 0",
        f"--out run {TOGETHER}": "JAX has been used",
        "--devices 200": "--devices is 200; JAX sees",
    }.items():
        assert message in refused(capsys, train_diffnet, options)
        assert not list(tmp_path.iterdir())
    assert mesh_of(Scaled(devices=1)) is None
