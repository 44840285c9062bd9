"""Scripts called as the shell would call them, in this process."""

import sys

import pytest

from dln_jax.cli.running import run


def command(script, *arguments):
    """Runs a script as the shell would, in this process."""
    previous = sys.argv
    sys.argv = [script.__name__, *map(str, arguments)]
    try:
        run(script.main, script.Arguments, prog=script.__name__.rpartition(".")[2])
    finally:
        sys.argv = previous


def refused(capsys, script, *arguments):
    """The one line that a user gets who made a mistake."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        command(script, *arguments)
    line = capsys.readouterr().err
    assert exit_.value.code == 2
    assert line.startswith("error: ") and line.count("\n") == 1 and "Traceback" not in line
    return line
