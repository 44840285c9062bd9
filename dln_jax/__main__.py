"""Entry point of the commands: `dln-jax NAME ...` or `python -m dln_jax NAME ...`."""

import ast
import difflib
import importlib
import importlib.util
import os
import sys
from pathlib import Path

from dln_jax.cli.commands import COMMANDS

REPORTS = "scripts.reports.commands"
"""Package of the commands that measure the project; part of a checkout, not of the wheel."""


def command(name: str, prog: str, *, package: str = "dln_jax.cli.commands") -> None:
    """Runs one command with the arguments of this process.

    Args:
        name: name of a module in `package`.
        prog: the command as the user typed it, for help and messages.
        package: package of the command.
    """
    # Factorisations here are small, and OpenBLAS's threads spin while they wait: a step of 560 tetrahedra took 4 to 20
    # times the processor time of one thread. OpenBLAS reads the variable when SciPy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.argv[0] = prog  # reports state the command that made them
    try:
        from dln_jax.cli.running import run

        module = importlib.import_module(f"{package}.{name}")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    run(module.main, module.Arguments, prog=prog, from_shell=True)


def main() -> None:
    """Runs the command named by the first argument; without one, or with --help, lists the commands."""
    prog = "dln-jax" if Path(sys.argv[0]).stem == "dln-jax" else "python -m dln_jax"
    words = sys.argv[1:]
    if words[:1] == ["--version"]:
        from importlib.metadata import version

        print(f"dln-jax {version('dln-jax')}")
        return
    if words[:1] == ["report"]:
        _choose(words[1:], f"{prog} report", REPORTS, report_names())
    else:
        _choose(words, prog, "dln_jax.cli.commands", COMMANDS, "\nreport NAME, in a checkout, measures the project\n")


def report_names() -> list[str]:
    """Sorted names of the reports of this checkout; empty for an installed package."""
    try:
        package = importlib.util.find_spec(REPORTS)
    except ModuleNotFoundError:
        package = None
    places = [] if package is None else package.submodule_search_locations or []
    return sorted(file.stem for place in places for file in Path(place).glob("[a-z]*.py"))


def _choose(words: list[str], prog: str, package: str, names: list[str], more: str = "") -> None:
    """Runs the command named by the first word, or lists the commands."""
    if not names:
        print("error: reports are part of the project's checkout, not of the installed package", file=sys.stderr)
        raise SystemExit(2)
    first = words[0] if words else "--help"
    try:
        if first in ("-h", "--help"):
            print(f"usage: {prog} COMMAND [OPTIONS]\n\n{prog} COMMAND --help states units and defaults\n\ncommands:")
            width = max(map(len, names))
            for name in names:
                print(f"  {name:{width}}  {first_line(name, package)}")
            print(more, end="", flush=True)
            return
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    name = first.replace("-", "_")
    if name not in names:
        like = difflib.get_close_matches(name, names, n=1)
        remedy = f"did you mean {like[0]}?" if like else f"choose from {', '.join(names)}"
        print(f"error: '{first:.80}' is not a command; {remedy}".replace("\n", " "), file=sys.stderr)
        raise SystemExit(2)
    del sys.argv[1 : len(sys.argv) - len(words) + 1]
    command(name, f"{prog} {name}", package=package)


def first_line(name: str, package: str = "dln_jax.cli.commands") -> str:
    """First line of a command's docstring."""
    # Parsed instead of imported: some commands take seconds to import.
    specification = importlib.util.find_spec(f"{package}.{name}")
    source = Path(str(specification and specification.origin)).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


if __name__ == "__main__":
    main()
