"""README.md as its reader meets it: every block runs as printed, after the README's own first command."""

import importlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tyro
from calls import command
from conftest import CACHE

from dln_jax.data import schema
from dln_jax.datasets import generators
from dln_jax.scenes.cart_pole import cart_pole

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()
BLOCKS = {
    language: re.findall(rf"^```{language}\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)
    for language in ("python", "bash")
}
INLINE = re.findall(r"`(python -m scripts\.[^`]*)`", re.sub(r"^```.*?^```", "", TEXT, flags=re.DOTALL | re.MULTILINE))
BUDGET = {
    "train_delan": shlex.split(
        "--optimizer adam --precision f64 --steps 40 --width 4 --depth 1 --batch 64 --no-figures"
    )
}
"""Put behind what the README gives, so that a script runs for a second: what is printed there stays as it is."""
NOT_RUN = (("pip", "install"), ("python", "-m", "pytest"), ("ruff",), ("pyright",))
"""What installs, and what checks this very repository."""


def commands(text):
    """The commands of a shell block, each as a list of words."""
    lines = text.replace("\\\n", " ").splitlines()
    return [shlex.split(part, comments=True) for line in lines for part in line.split("&&") if part.strip()]


def script_and_arguments(words):
    assert words[:2] == ["python", "-m"] and words[2].startswith("scripts."), words
    return importlib.import_module(f"dln_jax.commands.{words[2].removeprefix('scripts.')}"), words[3:]


SCRIPTS = [words for block in BLOCKS["bash"] for words in commands(block) if words[2:3] and words[2].startswith("scr")]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the reader's own data, in which the README's first command has run."""
    folder = tmp_path_factory.mktemp("reader")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        data = generators.uniform(cart_pole(friction=0.1), samples=60)
        schema.save(folder / "mine.npz", data._replace(label=np.array([f"run{index}" for index in range(60)])))
        run(SCRIPTS[0])
        yield folder


def run(words):
    script, arguments = script_and_arguments(words)
    command(script, *arguments, *BUDGET[words[2].removeprefix("scripts.")])


def test_every_command_of_a_block_is_known():
    """Each is one of a script, which runs below, or is named as one that does not run here."""
    every = [words for block in BLOCKS["bash"] for words in commands(block)]
    others = [words for words in every if words not in SCRIPTS]
    assert len(SCRIPTS) >= 2 and SCRIPTS[0] == ["python", "-m", "scripts.train_delan"]
    assert all(any(tuple(words[: len(known)]) == known for known in NOT_RUN) for words in others)


@pytest.mark.parametrize("words", SCRIPTS[1:], ids=shlex.join)
def test_a_command_of_a_block_runs(words, workplace):
    before = len(list((workplace / "runs").iterdir()))
    run(words)
    assert len(list((workplace / "runs").iterdir())) == before + 1


@pytest.mark.parametrize("text", INLINE)
def test_a_command_in_the_text_parses(text):
    script, arguments = script_and_arguments(shlex.split(text))
    tyro.cli(script.Arguments, args=arguments)


@pytest.mark.parametrize("block", BLOCKS["python"], ids=lambda block: block.strip().splitlines()[-1][:40])
def test_a_python_block_runs_in_a_fresh_interpreter_and_says_something(block, workplace):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAX_COMPILATION_CACHE_DIR": os.environ[CACHE]}
    result = subprocess.run(
        [sys.executable, "-c", block], env=environment, cwd=workplace, capture_output=True, text=True, timeout=300
    )
    assert result.returncode == 0, result.stderr
    assert re.search(r"\d\.\d", result.stdout) and not re.search("nan|inf", result.stdout), result.stdout


def test_there_are_blocks_to_run():
    """A README that no pattern matches would pass everything above."""
    assert len(BLOCKS["python"]) >= 4 and len(INLINE) >= 10
    assert sum(len(blocks) for blocks in BLOCKS.values()) * 2 == len(re.findall(r"^```", TEXT, re.MULTILINE))
