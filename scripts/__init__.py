"""Command lines: thin layers from arguments to library calls to files and figures."""

import os
import sys
from types import TracebackType

# Factorisations here are small: OpenBLAS's threads spin while they wait for each other, which took 4 to 20 times the
# processor time of one thread in a step of 560 tetrahedra. Read when SciPy is first imported; what is set stays.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _in_a_word(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """An interrupt while a program is still being imported is no error of it."""
    if issubclass(kind, KeyboardInterrupt):
        print("interrupted", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, trace)


if sys.argv[:1] == ["-m"]:  # `python -m scripts.NAME`, which has not been imported yet
    sys.excepthook = _in_a_word
