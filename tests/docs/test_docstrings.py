"""The examples in the docstrings of the public names."""

import subprocess
import sys

import pytest

PROGRAM = """
import doctest

import dln_jax

finder, runner = doctest.DocTestFinder(recurse=False), doctest.DocTestRunner()
tests = [test for name in dln_jax.__all__ for test in finder.find(getattr(dln_jax, name), name, globs={})]
for test in sorted(tests, key=lambda test: test.name != "enable_low_latency"):  # before any array
    runner.run(test)
missing = [test.name for test in tests if not test.examples and test.name != "__version__"]
assert not missing, f"no example: {missing}"
assert not runner.failures
"""


@pytest.mark.slow
def test_every_public_name_has_an_example_that_runs_as_printed(tmp_path):
    result = subprocess.run([sys.executable, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True)
    assert not result.returncode, result.stdout + result.stderr
