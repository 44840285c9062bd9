"""Compiled programs that commands keep for each other, in processes of their own: JAX is told once."""

import os
import subprocess
import sys

import pytest
from interpreters import ROOT, Program, interpreters

PROGRAM = '''
"""A command that compiles a tiny program."""
import dataclasses
import jax, jax.numpy as jnp
from dln_jax.runs import running
from dln_jax.runs import devices

devices.LEAST_SECONDS = 0.0

@dataclasses.dataclass(frozen=True)
class Arguments:
    """Options of the compiled function."""
    size: int = 3
    """Size of the vector."""

def main(given):
    before = devices.compilation()["cached"]
    jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones(given.size))
    print("found", devices.compilation()["cached"] - before)

running.run(main, Arguments, prog="tiny", began=0.0)
'''


@pytest.fixture
def lines_of(tmp_path):
    """The lines of the command for each of some arguments at once, in an interpreter that JAX's variables do not reach.

    The user's cache is in the test's folder.
    """
    (tmp_path / "tiny.py").write_text(PROGRAM)
    free = {key: value for key, value in os.environ.items() if not key.startswith("JAX_")}
    with interpreters(free) as run_programs:

        def lines_of(*each, cache=tmp_path):
            told = {**os.environ, "XDG_CACHE_HOME": str(cache)}
            results = run_programs(tmp_path, *(Program(tmp_path / "tiny.py", tmp_path, told, given) for given in each))
            assert [(result.returncode, result.stderr) for result in results] == [(0, "")] * len(each)
            return [result.stdout.splitlines() for result in results]

        yield lines_of


def test_a_second_run_finds_its_programs(lines_of, tmp_path):
    """Two first runs at once, and what is left of them by kills, do no harm."""
    lines_of((), ("--size", "4"))
    kept = sorted((tmp_path / "dln_jax" / "programs").glob("*-cache"))
    ((found, said),) = lines_of(())
    assert 0 < int(found.removeprefix("found ")) <= len(kept) and "from the cache" in said
    # JAX writes when a program was used after the program itself; a kill may come between, or before the end of either.
    torn, other = ((each, each.with_name(f"{each.name.removesuffix('-cache')}-atime")) for each in kept[:2])
    torn[0].write_bytes(torn[0].read_bytes()[:20])
    torn[1].unlink()
    other[1].write_bytes(b"")
    assert lines_of(("--no-compilation-cache",)) == [["found 0"]]
    lines_of(())
    lines_of(("--size", "4"))
    assert lines_of(())[0][0] == found and all(each.stat().st_size for each in (*torn, *other))
    # A cache that cannot be written is one line at most.
    ((first, *rest),) = lines_of((), cache=tmp_path / "tiny.py")
    assert first == "found 0" and len(rest) <= 1 and all("none is kept" in line for line in rest)


def test_the_folder_that_jax_was_told_stays(tmp_path):
    (tmp_path / "tiny.py").write_text(PROGRAM)
    told = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "own"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(tmp_path), **told}
    done = subprocess.run([sys.executable, str(tmp_path / "tiny.py")], env=environment, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    assert list(tmp_path.glob("own/*-cache")) and not (tmp_path / "dln_jax").exists()
