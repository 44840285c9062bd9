"""All command lines: one line for a mistake, help that says what an option takes, bars that fit."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import pytest
from rich.console import Console

from dln_jax.__main__ import main
from dln_jax.commands import COMMANDS
from dln_jax.errors import FitRefused
from dln_jax.metrics.verdict import Verdict
from dln_jax.options import Unstated, choice
from dln_jax.runs.folder import CONFIG, run_folder
from dln_jax.runs.progress import progress
from dln_jax.runs.running import run

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Arguments:
    """Arguments of a command that does nothing."""

    kind: Literal["this", "that"] = "this"
    """Which."""
    names: Annotated[str, choice(("one", "two"), several=True)] = "one,two"
    """Some (default: all)."""
    steps: Unstated[int] = None
    """How many (default: 7)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """Floating-point type (default: f64)."""


def say(given: Arguments) -> None:
    print(given)


def ended(monkeypatch, main, *arguments, options=Arguments):
    """The status with which a command ends."""
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as stop:
        run(main, options, prog="command")
    return stop.value.code


def test_what_cannot_be_parsed_is_one_line(monkeypatch, capsys):
    for arguments, complaint in {
        "--kind other": "--kind is 'other'; choose from this, that",
        "--steps many": "--steps must be a whole number; got 'many'",
        "--steps": "--steps lacks a value",
        "--stepz 3": "unrecognised option: --stepz; did you mean --steps?",
        "--precision None": "--precision is 'None'; choose from f32, f64",
        "stray": "unrecognised option: stray",
    }.items():
        assert ended(monkeypatch, say, *arguments.split()) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1 and line.startswith(f"error: {complaint}") and "--help)" in line


def test_a_bar_shows_count_text_and_time_left_whole():
    text = "motions: loss 1.23e-05  validation 1.23e-05"
    for width in (80, 120):
        out = io.StringIO()
        with progress(20_000, console=Console(file=out, force_terminal=True, width=width, color_system=None)) as show:
            show(5_000, text)
            show(19_990, text)
        *_, last = filter(None, re.split(r"[\r\n]", re.sub(r"\x1b\[[0-9?]*[A-Za-z]", "", out.getvalue())))
        assert len(last) <= width and "19990/20000" in last and text in last and re.search(r"left \d\d:\d\d", last)


def test_a_list_that_nobody_reads_ends_without_a_word():
    """Its output stays in a buffer that nobody reads, and is flushed as the command ends."""
    options = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-m", "dln_jax"], **options) as child:
        child.stdout.close()
        said = child.stderr.read()
    assert said == b"" and child.returncode == 141


CONSOLE = "import sys\nfrom dln_jax.__main__ import main\nsys.exit(main())\n"
"""The console script that pip writes for the package."""


def ways(folder):
    """The three ways of calling `make_data`."""
    (folder / "dln-jax").write_text(CONSOLE)
    return {
        "dln-jax make_data": [str(folder / "dln-jax"), "make_data"],
        "python -m dln_jax make_data": ["-m", "dln_jax", "make_data"],
        "python -m scripts.make_data": ["-m", "scripts.make_data"],
    }


def test_an_interrupt_during_imports_is_one_word(tmp_path):
    """The first import of the command waits, so that the interrupt meets it, also of a parent that ignores its own."""
    heard = "import signal, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    (tmp_path / "jax.py").write_text(f"{heard}print('importing', flush=True)\ntime.sleep(60)\n")
    options = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    for way in ways(tmp_path).values():
        told = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
        with subprocess.Popen([sys.executable, *way, "--out", "data.npz"], env=told, **options) as child:
            assert child.stdout.readline() == "importing\n"
            time.sleep(0.05)
            child.send_signal(signal.SIGINT)
            said = child.stderr.read()
        assert said == "interrupted\n" and child.returncode in (-signal.SIGINT, 130)


COLLECTED = """
import gc, signal, sys, time
from dln_jax.process import resend_interrupt

def interrupt(*_):
    gc.callbacks.clear()
    raise KeyboardInterrupt

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.unraisablehook = resend_interrupt
gc.callbacks.append(interrupt)
gc.collect()
try:
    time.sleep(60)
except KeyboardInterrupt:
    sys.exit(7)
"""


def test_an_interrupt_that_the_garbage_collector_swallows_is_sent_again():
    assert subprocess.run([sys.executable, "-c", COLLECTED]).returncode == 7


ENDLESS = """
import dataclasses
import jax
from dln_jax.runs import running

@dataclasses.dataclass(frozen=True)
class Arguments:
    "Starts a program that never ends."

def main(given):
    jax.jit(lambda x: jax.lax.while_loop(lambda x: x[0, 0] > 0, lambda x: x @ x / 100, x))(jax.numpy.ones((100, 100)))
    raise KeyboardInterrupt

running.run(main, Arguments, prog="endless", line=[], began=0.0)
"""


def test_an_interrupt_ends_a_command_whose_program_still_runs(tmp_path):
    """XLA would abort the process, or hold it until the program ends."""
    (tmp_path / "endless.py").write_text(ENDLESS)
    told = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, tmp_path / "endless.py"], cwd=tmp_path, env=told, capture_output=True, text=True, timeout=100
    )
    assert (done.returncode, done.stderr) == (130, "interrupted\n")


def test_each_way_of_calling_names_itself(tmp_path):
    told = {**os.environ, "PYTHONPATH": str(ROOT)}
    for name, way in ways(tmp_path).items():
        line = [sys.executable, *way, "--stepz"]
        done = subprocess.run(line, cwd=tmp_path, env=told, capture_output=True, text=True)
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and done.stdout == ""
        assert f"(see {name} --help)" in done.stderr


def test_without_a_name_there_is_a_list_and_an_unknown_one_is_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["/bin/dln-jax"])
    main()
    out = capsys.readouterr().out
    assert "usage: dln-jax COMMAND" in out
    assert all(re.search(rf"^ *{name} .*\.$", out, re.MULTILINE) for name in COMMANDS)
    for nonsense in ("teapot", "", "../x", "a\nb", "x" * 5000, "--steps", "__init__", "train-delen"):
        monkeypatch.setattr(sys, "argv", ["dln-jax", nonsense])
        with pytest.raises(SystemExit) as stop:
            main()
        line = capsys.readouterr().err
        assert stop.value.code == 2 and line.count("\n") == 1 and len(line) < 1000
        assert line.startswith("error: ") and "is not a command; " in line
    assert "did you mean train_delan?" in line


@dataclass(frozen=True)
class Resumable:
    """Arguments of a command that can continue."""

    resume: bool = False
    """Continue."""
    continues: ClassVar = True


def test_how_a_command_ended_is_its_status_and_one_line(monkeypatch, capsys, tmp_path):
    folder = tmp_path / "run"

    def main(given, stored=True):
        with run_folder(folder, "command"):
            if stored:
                (folder / CONFIG).write_text("{}")
            raise KeyboardInterrupt

    def refuse(given):
        raise FitRefused(Verdict("refused", "nMSE 22.7", "check the sign of tau"))

    for options, function, status, said in (
        (Resumable, main, 130, f"interrupted; continue with: command --out {folder} --resume\n"),
        (Resumable, partial(main, stored=False), 130, f"interrupted; {folder} is incomplete\n"),
        (Arguments, main, 130, f"interrupted; {folder} is incomplete\n"),
        (Arguments, refuse, 1, "error: the fit is refused: nMSE 22.7; check the sign of tau\n"),
    ):
        assert ended(monkeypatch, function, options=options) == status
        assert capsys.readouterr().err == said
        shutil.rmtree(folder, ignore_errors=True)


def test_every_command_has_a_script():
    texts = {path.stem: path.read_text() for path in (ROOT / "scripts").glob("*.py")}
    for name in COMMANDS:
        assert f'command("{name}")' in texts[name]
    assert {*texts} == {*COMMANDS, "report", "__init__"}
