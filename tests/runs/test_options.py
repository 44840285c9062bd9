"""Options are stated without importing JAX: the names and numbers in them are those of the library."""

import dataclasses
import importlib
import re
import subprocess
import sys
from types import SimpleNamespace
from typing import get_args, get_type_hints

import pytest

from dln_jax.commands import COMMANDS, identify, train_delan, train_diffnet, train_hnn, train_hnn_task, train_value
from dln_jax.control.optimal.own_plants import FOLDER
from dln_jax.data.functions import PUBLISHED
from dln_jax.learning.fits.settings import WAYS
from dln_jax.mechanics.friction import LAWS, USUAL
from dln_jax.nn.activations import ALL
from dln_jax.options import SCENES
from dln_jax.runs.arguments import arguments_for, resolved
from dln_jax.runs.help import options_of
from dln_jax.runs.running import run
from dln_jax.scenes import registry
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.zoo.catalogue import CATALOGUE

HELP = """
import importlib, io, contextlib, sys
import dln_jax.__main__
from dln_jax.commands import COMMANDS
from dln_jax.runs.running import run
for name in COMMANDS:
    module = importlib.import_module(f"dln_jax.commands.{name}")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        run(module.main, module.Arguments, prog=name, line=["--help"])
    with contextlib.redirect_stderr(io.StringIO()), contextlib.suppress(SystemExit):
        run(module.main, module.Arguments, prog=name, line=["--no-such-option"])
    heavy = {"jax", "scipy", "matplotlib", "haiku"} & set(sys.modules)
    assert not heavy, (name, heavy)
print(len(COMMANDS))
"""


def test_help_and_mistakes_import_no_jax():
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(len(COMMANDS))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_short_and_every_option_has_a_text(name, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    module = importlib.import_module(f"dln_jax.commands.{name}")
    texts = []
    for line in ("-h", "--help-all"):
        with pytest.raises(SystemExit, match="0"):
            run(module.main, module.Arguments, prog=name, line=[line])
        texts.append(capsys.readouterr().out.splitlines())
    short, whole = texts
    assert len(short) <= 60 and max(map(len, short + whole)) <= 80
    assert sum(line.startswith("  --") for line in short) <= 22
    assert all(text.strip() for *_, text in options_of(arguments_for(module.Arguments, {})))


def shown(options, name):
    """The choices that the help of an option shows."""
    metavar = get_type_hints(options, include_extras=True)[name].__metadata__[0].metavar
    return set(metavar.strip("{}").split(","))


def test_names_and_defaults_in_options_are_those_of_the_library():
    assert set(SCENES) == set(registry.SCENES)
    assert set(WAYS) - {"auto"} <= set(CATALOGUE)
    assert set(train_hnn_task.GENERATED) == set(PROTOCOLS)
    assert set(train_diffnet.NAMES) == set(PUBLISHED)
    assert set(identify.LAWS) == set(LAWS)
    assert shown(train_value.TrainingOptions, "plant") == {*(path.stem for path in FOLDER.glob("*.xml")), "FILE"}
    assert shown(train_diffnet.Arguments, "activation") == set(ALL)
    assert set(get_args(get_type_hints(train_hnn_task.Motion)["model"])) - {"auto"} <= set(CATALOGUE)
    defaults = {field.name: field.default for field in dataclasses.fields(identify.Arguments)}
    assert defaults["friction"] == ",".join(USUAL)


def test_an_option_exists_for_the_choices_that_read_it():
    for command, stated, present, absent in [
        (train_delan, {}, "width target scene batch", "robot degree"),
        (train_delan, {"data": "log.npz"}, "robot parents seconds", "width optimizer"),
        (train_delan, {"model": "trigonometric"}, "degree objective", "width seconds seeds"),
        (train_hnn_task, {}, "trajectories width", "data noise degree"),
        (train_hnn_task, {"task": "measured"}, "data noise order", "trajectories degree"),
        (train_value, {"stored": "run"}, "starts", "plant width seed"),
    ]:
        names = {field.name for field in dataclasses.fields(arguments_for(command.Arguments, stated))}
        assert names >= {*present.split()} and names.isdisjoint(absent.split())


def test_every_model_of_a_command_has_a_method():
    for command in (train_delan, train_hnn):
        names = re.findall(r"'([\w-]+)'", repr(command.Arguments.__annotations__["model"]))
        assert names and set(names) <= set(WAYS)


def test_a_zero_that_was_stated_is_no_default():
    assert resolved(SimpleNamespace(steps=0, width=None), {"steps": 5, "width": 8}) == {"steps": 0, "width": 8}
