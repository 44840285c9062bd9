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
    """Whether this process was started as `dln-jax`, `python -m dln_jax` or `python -m scripts.NAME`, by no other."""
    words = sys.orig_argv
    package, _, name = words[words.index("-m") + 1 :][0].partition(".") if "-m" in words[:-1] else ("", "", "")
    script = package == "scripts" and (Path(__file__).parent / "commands" / f"{name}.py").is_file()
    return script or (package == "dln_jax" and not name) or Path(sys.argv[0]).stem == "dln-jax"


if is_command():
    sys.excepthook = in_a_word
