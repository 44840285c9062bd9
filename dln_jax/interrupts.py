"""An interrupt while a command of this package is still being imported is a word, and no trace."""

import sys
from pathlib import Path
from types import TracebackType


def in_a_word(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Takes the place of `sys.excepthook`: an interrupt is no error of the program."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


def is_command() -> bool:
    """Whether this process was started as `dln-jax` or `python -m dln_jax`, and not by a program that imports it."""
    words = sys.orig_argv
    module = words[words.index("-m") + 1 :][:1] if "-m" in words else []
    return module == ["dln_jax"] or Path(sys.argv[0]).stem == "dln-jax"


if is_command():
    sys.excepthook = in_a_word
