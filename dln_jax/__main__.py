"""The commands from the shell: `dln-jax NAME ...`, or `python -m dln_jax NAME ...`."""

import ast
import importlib
import importlib.util
import os
import sys
from pathlib import Path

from dln_jax.commands import command_names


def command(name: str, prog: str) -> None:
    """Runs one command with the arguments of this process.

    Args:
        name: of a module in `dln_jax.commands`.
        prog: what the user typed to get here, for help and for messages.
    """
    # Factorisations here are small: OpenBLAS's threads spin while they wait for each other, which took 4 to 20
    # times the processor time of one thread in a step of 560 tetrahedra. Read as SciPy is imported; what is set stays.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.argv[0] = prog  # a report says how it was made
    try:
        from dln_jax.command_line.running import run

        module = importlib.import_module(f"dln_jax.commands.{name}")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
    run(module.main, module.Arguments, prog=prog, from_shell=True)


def main() -> None:
    """The command that the first argument names; without one, or with --help, what there is."""
    prog = "dln-jax" if Path(sys.argv[0]).stem == "dln-jax" else "python -m dln_jax"
    names = command_names()
    given = sys.argv[1] if len(sys.argv) > 1 else "--help"
    try:
        if given in ("-h", "--help"):
            print(f"usage: {prog} COMMAND [OPTIONS]\n\n{prog} COMMAND --help states units and defaults\n\ncommands:")
            width = max(map(len, names))
            for name in names:
                print(f"  {name:{width}}  {first_line(name)}")
            sys.stdout.flush()
            return
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(141) from None
    name = given.replace("-", "_")
    if name not in names:
        print(f"error: '{given:.80}' is no command; choose from {', '.join(names)}".replace("\n", " "), file=sys.stderr)
        raise SystemExit(2)
    del sys.argv[1]
    command(name, f"{prog} {name}")


def first_line(name: str) -> str:
    """What a command says that it does."""
    # Read and not imported: some commands take seconds to import.
    specification = importlib.util.find_spec(f"dln_jax.commands.{name}")
    source = Path(str(specification and specification.origin)).read_text(encoding="utf-8")
    return (ast.get_docstring(ast.parse(source)) or "").partition("\n")[0]


if __name__ == "__main__":
    main()
