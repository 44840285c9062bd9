"""Random programs give in C what they give in JAX, under sanitizers, and the same text in every process."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import random_programs
from comparison import files_of
from compilers import needs_compiler
from conftest import slow_among
from sanitized import in_sanitized_c

from dln_jax.export.c import lowering

BATCHES = [range(2), range(2, 20), range(20, 40), range(40, 60)]
"""Seeds of programs that are compiled together; the slow tests have all but the first."""
BOUND = 1e-12


@pytest.fixture(autouse=True)
def small_functions_are_called(monkeypatch):
    """Not inlined, as only large ones are otherwise."""
    monkeypatch.setattr(lowering, "_LARGE_CALL", 6)


def programs_of(seeds):
    """Programs with examples, and states of each, by name."""
    drawn = {f"program_{seed}": random_programs.program(seed, count=3) for seed in seeds}
    programs = {name: (function, states[0]) for name, (function, states) in drawn.items()}
    return programs, {name: states for name, (_, states) in drawn.items()}


def assert_agree(programs, states, folder, **options):
    """Real numbers to the bound, relative to the result's largest; others exactly."""
    got = in_sanitized_c(programs, states, folder, **options)
    for name, (function, _) in programs.items():
        jitted = jax.jit(function)
        for state, ours in zip(states[name], got[name], strict=True):
            for place, (mine, theirs) in enumerate(zip(ours, map(np.asarray, jitted(*state)), strict=True)):
                assert mine.shape == theirs.shape, (name, place)
                finite = np.isfinite(theirs)
                atol = BOUND * max(1, np.abs(theirs[finite]).max(initial=0)) if theirs.dtype.kind == "f" else 0
                np.testing.assert_allclose(mine, theirs, rtol=0, atol=atol, err_msg=f"{name}, result {place}")


@needs_compiler
@pytest.mark.parametrize("finite", [False, True], ids=["any-arguments", "finite-arguments"])
@pytest.mark.parametrize("seeds", slow_among(BATCHES, lambda seeds: 0 not in seeds), ids=str)
def test_random_programs_agree_with_jax(seeds, finite, tmp_path):
    assert_agree(*programs_of(seeds), tmp_path, finite=finite)


@needs_compiler
def test_a_called_function_may_return_an_array_without_elements(tmp_path):
    @jax.jit
    def called(x):
        return x[:0], jnp.cos(jnp.sin(x) * 2 + x) ** 2 - 1

    state = (np.array([0.3, -1.2]),)
    assert_agree({"f": (lambda a: [*called(a), *called(2 * a)], state)}, {"f": [state]}, tmp_path)


TEXT_OF = """
import sys
import jax
jax.config.update("jax_enable_x64", True)
sys.path[:0] = sys.argv[1:]
from test_random_programs import digest
print(digest(range(8)))
"""


def digest(seeds):
    """Returns the digest of the programs' C."""
    return hashlib.sha256(files_of(programs_of(seeds)[0])["model.c"]).hexdigest()


def test_the_text_is_the_same_in_every_process():
    here = Path(__file__).parent
    command = [sys.executable, "-c", TEXT_OF, here, here.parents[1]]
    processes = [
        subprocess.Popen(command, env={**os.environ, "PYTHONHASHSEED": str(seed)}, stdout=subprocess.PIPE, text=True)
        for seed in range(2)
    ]
    digests = [process.communicate(timeout=1800)[0] for process in processes]
    assert all(process.returncode == 0 for process in processes)
    assert len(digests[0]) > 60 and len(set(digests)) == 1
