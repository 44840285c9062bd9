"""Random programs give in C what they give in JAX, under sanitizers, and the same text in every process."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_programs
from sanitized import in_sanitized_c

from dln_jax.export.c import jaxprs
from dln_jax.export.c.source import source_files
from dln_jax.types import InputError

needs_compiler = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc on the PATH")
BATCH, STATES = 20, 3
FEW, ALL_SUPPORTED, EVERY = 5, 40, 500
"""Seeds below these are tried by default; have C for every program; are tried by the slow tests."""
BOUND = 1e-12
MOST_REFUSED = 1
"""Programs of a batch that may be refused, with one clear line each."""


@pytest.fixture(autouse=True)
def small_functions_are_called(monkeypatch):
    """Not inlined, as only large ones are otherwise."""
    monkeypatch.setattr(jaxprs, "_LARGE_CALL", 6)


def batches(first, last):
    return [range(start, min(start + BATCH, last)) for start in range(first, last, BATCH)]


def refused(program):
    """Whether the export says in one line that a primitive has no C."""
    try:
        source_files({"f": program}, name="model")
    except InputError as error:
        assert "\n" not in str(error) and "has no C" in str(error)
        return True
    return False


def compared(seeds, folder, **options):
    """Fails unless all of these programs that C has agree with JAX; how many it does not have."""
    every = {f"program_{seed}": random_programs.program(seed) for seed in seeds}
    states = {
        name: random_programs.states(seed, program[1], STATES)
        for seed, (name, program) in zip(seeds, every.items(), strict=True)
    }
    programs = every
    try:
        got = in_sanitized_c(programs, states, folder, **options)
    except InputError:
        programs = {name: program for name, program in every.items() if not refused(program)}
        assert programs.keys() != every.keys()
        got = in_sanitized_c(programs, states, folder, **options)
    for name, (function, _) in programs.items():
        jitted = jax.jit(function)
        for state, ours in zip(states[name], got[name], strict=True):
            for place, (mine, theirs) in enumerate(zip(ours, jitted(*state), strict=True)):
                close(mine, np.asarray(theirs), f"{name}, result {place}")
    return len(every) - len(programs)


def close(ours, theirs, where):
    """Real numbers to the bound, relative to the result's largest; others exactly."""
    assert ours.shape == theirs.shape, where
    if theirs.dtype.kind == "f":
        scale = max(1.0, np.abs(theirs[np.isfinite(theirs)]).max(initial=0))
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=BOUND * scale, err_msg=where)
    else:
        np.testing.assert_array_equal(ours, theirs, err_msg=where)


either_contract = pytest.mark.parametrize("finite", [False, True], ids=["any-arguments", "finite-arguments"])


@needs_compiler
@either_contract
def test_a_few_random_programs_agree_with_jax(finite, tmp_path):
    assert not compared(range(FEW), tmp_path, finite=finite)


@needs_compiler
def test_a_called_function_may_return_an_array_without_elements(tmp_path):
    @jax.jit
    def called(x):
        return x[:0], jnp.cos(jnp.sin(x) * 2 + x) ** 2 - 1

    def function(a):
        return [*called(a), *called(2 * a)]

    state = (np.array([0.3, -1.2]),)
    (results,) = in_sanitized_c({"f": (function, state)}, {"f": [state]}, tmp_path)["f"]
    for ours, theirs in zip(results, function(*state), strict=True):
        close(ours, np.asarray(theirs), "result")


@pytest.mark.slow
@needs_compiler
@either_contract
@pytest.mark.parametrize("seeds", batches(FEW, ALL_SUPPORTED), ids=str)
def test_random_programs_agree_with_jax(seeds, finite, tmp_path, pytestconfig):
    if finite != (seeds[0] > FEW) and not pytestconfig.getoption("--every-export"):
        pytest.skip("the other value of finite is compared only with --every-export, which takes minutes")
    assert not compared(seeds, tmp_path, finite=finite)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("place, seeds", list(enumerate(batches(ALL_SUPPORTED, EVERY))), ids=str)
def test_more_random_programs_agree_with_jax(place, seeds, tmp_path, pytestconfig):
    if place % 9 and not pytestconfig.getoption("--every-export"):
        pytest.skip("this batch is compared only with --every-export, which takes minutes")
    assert compared(seeds, tmp_path) <= MOST_REFUSED


TEXT_OF = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, sys.argv[1])
from test_random_programs import digest
print(digest(range(int(sys.argv[2]), int(sys.argv[3]))))
"""


def digest(seeds):
    """Returns the digest of the programs' C."""
    programs = {f"program_{seed}": random_programs.program(seed) for seed in seeds}
    return hashlib.sha256(source_files(programs, name="model")["model.c"]).hexdigest()


@pytest.mark.slow
def test_the_text_is_the_same_in_every_process():
    check_text(0, 12)


@pytest.mark.slow
def test_the_text_of_more_programs_is_the_same_in_every_process(pytestconfig):
    if not pytestconfig.getoption("--every-export"):
        pytest.skip("all programs are compared three times only with --every-export, which takes minutes")
    check_text(0, EVERY)


def check_text(first, last):
    here = str(Path(__file__).parent)
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", TEXT_OF, here, str(first), str(last)],
            env={**os.environ, "PYTHONHASHSEED": str(seed)}, stdout=subprocess.PIPE, text=True,
        )
        for seed in (0, 1, 2)
    ]  # fmt: skip
    digests = [process.communicate(timeout=1800)[0] for process in processes]
    assert all(process.returncode == 0 for process in processes)
    assert len(digests[0]) > 60 and len(set(digests)) == 1
