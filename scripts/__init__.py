"""`python -m scripts.NAME` for each command of dln_jax."""

import sys
from types import TracebackType


def _in_a_word(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """An interrupt while a program is still being imported is no error of it."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.argv[:1] == ["-m"]:  # which has not been imported yet
    sys.excepthook = _in_a_word
