"""Scripts called as the shell would call them, in this process, and mistakes that are one line."""

import contextlib
import json
import sys

import pytest

from dln_jax.runs.running import run
from dln_jax.types import InputError


def words_of(arguments):
    """Words of a command line; a text that begins with -- holds options as they are typed."""
    for text in map(str, arguments):
        yield from text.split() if text.startswith("--") else [text]


def command(script, *arguments):
    """Runs a script as the shell would, in this process."""
    previous = sys.argv
    sys.argv = [script.__name__, *words_of(arguments)]
    try:
        run(script.main, script.Arguments, prog=script.__name__.rpartition(".")[2])
    finally:
        sys.argv = previous


def exit_status(script, *arguments):
    """The status with which a script ends that does not succeed."""
    with pytest.raises(SystemExit) as exit_:
        command(script, *arguments)
    return exit_.value.code


def refused(capsys, script, *arguments):
    """The one line that a user gets who made a mistake."""
    capsys.readouterr()
    assert exit_status(script, *arguments) == 2
    line = capsys.readouterr().err
    assert line.startswith("error: ") and line.count("\n") == 1 and "Traceback" not in line
    return line


def assert_refused(capsys, script, rows, *options, out):
    """Asserts that the script refuses the arguments of each row with the row's words, and does not make its folder."""
    for *arguments, words in rows:
        assert words in refused(capsys, script, *options, "--out", out, *arguments), arguments
        assert not out.exists(), arguments


@contextlib.contextmanager
def one_line(words=None):
    """Asserts that the block raises an `InputError` of one line in which the pattern, if any, occurs."""
    with pytest.raises(InputError, match=words) as caught:
        yield caught
    assert "\n" not in str(caught.value)


def json_of(path):
    """Returns the contents of a JSON file."""
    return json.loads(path.read_text())
