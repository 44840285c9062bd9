"""Entry point of the commands: `dln-jax NAME ...` or `python -m dln_jax NAME ...`."""

import ast
import difflib
import importlib
import importlib.util
import os
import sys
import time
from pathlib import Path

from dln_jax.commands import COMMANDS

BEGAN = time.perf_counter()
"""Start of the process; `--seconds` counts from here."""


def command(name: str, prog: str = "") -> None:
    """Runs one command with the arguments of this process.

    Args:
        name: name of a module in `dln_jax.commands`.
        prog: the command as the user typed it, for help and messages (default: `python -m scripts.NAME`).
    """
    # Factorisations here are small, and idle OpenBLAS threads spin: a step of 560 tetrahedra took 4 to 20 times the
    # processor time of one thread. OpenBLAS reads the variable when SciPy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    prog = prog or f"python -m scripts.{name}"
    sys.argv[0] = prog  # reports record the command
    try:
        from dln_jax.runs.running import run

        module = importlib.import_module(f"dln_jax.commands.{name}")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    run(module.main, module.Arguments, prog=prog, began=BEGAN)


def main() -> None:
    """Runs the command named by the first argument; without one, or with --help, lists the commands."""
    prog = "dln-jax" if Path(sys.argv[0]).stem == "dln-jax" else "python -m dln_jax"
    words = sys.argv[1:]
    if words[:1] == ["--version"]:
        from importlib.metadata import version

        print(f"dln-jax {version('dln-jax')}")
        return
    first = words[0] if words else "--help"
    try:
        if first in ("-h", "--help"):
            print(f"usage: {prog} COMMAND [OPTIONS]\n\n{prog} COMMAND --help states units and defaults\n\ncommands:")
            width = max(map(len, COMMANDS))
            for name in COMMANDS:
                print(f"  {name:{width}}  {first_line(name)}")
            print("\nIn the repository, python -m scripts.report NAME repeats a benchmark.", flush=True)
            return
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    name = first.replace("-", "_")
    if name not in COMMANDS:
        like = difflib.get_close_matches(name, COMMANDS, n=1)
        remedy = f"did you mean {like[0]}?" if like else f"choose from {', '.join(COMMANDS)}"
        print(f"error: '{first:.80}' is not a command; {remedy}".replace("\n", " "), file=sys.stderr)
        raise SystemExit(2)
    del sys.argv[1]
    command(name, f"{prog} {name}")


def first_line(name: str) -> str:
    """First line of a command's docstring."""
    # Parsed instead of imported: some commands take seconds to import.
    specification = importlib.util.find_spec(f"dln_jax.commands.{name}")
    source = Path(str(specification and specification.origin)).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


if __name__ == "__main__":
    main()
