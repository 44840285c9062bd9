"""Options for devices and processes, as far as one process can tell."""

import jax
import pytest
from calls import refused

from dln_jax.cli.arguments import arguments_for, arguments_of
from dln_jax.cli.commands import train_delan, train_diffnet, train_hnn, train_locomotion, train_value
from dln_jax.cli.options import Scaled
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import stored_arguments
from dln_jax.types import InputError

TOGETHER = ("--processes", "2", "--coordinator", "127.0.0.1:61440", "--process-id", "1")


def test_several_processes_need_a_folder_that_all_see(capsys):
    assert "by --out" in refused(capsys, train_diffnet, *TOGETHER)
    commands = (train_delan, train_hnn, train_diffnet, train_locomotion, train_value)
    assert all(issubclass(arguments_for(command.Arguments, {}), Scaled) for command in commands)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (TOGETHER[:2], "--coordinator and --process-id missing"),
        (("--processes", "0"), "expected a positive whole number"),
        (("--devices", "0"), "--devices is 0"),
    ],
)
def test_half_of_the_options_is_refused(capsys, monkeypatch, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, train_diffnet, *options)
    assert not list(tmp_path.iterdir())


def test_processes_are_started_before_jax_is_used(capsys, tmp_path):
    jax.devices()
    assert "JAX has been used" in refused(capsys, train_diffnet, "--out", tmp_path / "run", *TOGETHER)
    assert not list(tmp_path.iterdir())


def test_more_devices_than_there_are_are_refused():
    with pytest.raises(InputError, match="--devices is 1000; JAX sees"):
        mesh_of(Scaled(devices=1000))
    assert mesh_of(Scaled(devices=1)) is None


def test_a_run_does_not_remember_where_it_was_computed():
    there = arguments_of(train_diffnet.Arguments, devices=4, processes=2, coordinator="node1:61440", process_id=1)
    assert stored_arguments(there) == stored_arguments(arguments_of(train_diffnet.Arguments))
