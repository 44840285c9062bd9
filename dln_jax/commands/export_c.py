"""Export the model of a run as C99 source.

The run comes from a training command. The export has a header, a source, a demo program and a CMake file, and depends
on nothing but <math.h>. The functions take one state, in SI units. A model of dynamics has inverse and forward
dynamics, gravity, Coriolis force, friction, mass matrix, energy, integration steps x_next = F(x, u, dt), and the exact
derivatives of all of them. A model of a phase space has rates and steps; a differential network has its value,
Jacobian and Hessian. Without --functions, all functions are exported except those that take long to compile. The C code
allocates no memory and keeps no state. dln_jax.load_c compiles it and calls it from Python; dln_jax.export_c exports
any other JAX function.
"""

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.errors import InputError
from dln_jax.options import Unstated


@dataclass(frozen=True)
class Arguments:
    """What to export, and where."""

    run: Path
    """Folder of a training run, with model.json and model.safetensors."""
    out: Unstated[Path] = None
    """Folder of NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt (default: RUN-c-1, -2, ... beside the folder
    RUN)."""
    functions: Unstated[tuple[str, ...]] = None
    """Names, such as inverse_dynamics step_rk4_jacobian (default: all; a wrong name lists them)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """float or double (default: the precision of the training)."""
    name: str = "model"
    """Prefix of the files' and functions' names in C."""
    iterations: int = 3
    """Newton steps of the implicit midpoint rule."""
    temperature: Unstated[float] = None
    """Temperature of the C functions, °C, if friction depends on it (default: the reference of the identification)."""
    casadi: bool = False
    """Add NAME_casadi.c: the functions with exact derivatives for CasADi's external and for acados."""
    finite: bool = False
    """Assume finite arguments and skip the structural zeros of derivatives; a NaN may then not reach all results."""
    overwrite: bool = False
    """Replace the files of an earlier export (files of a run are never replaced)."""


def main(options: Arguments) -> None:
    """Exports the model, and prints the files and the functions left out."""
    from dln_jax.export.c.source import export_c
    from dln_jax.export.functions import functions_of_run
    from dln_jax.zoo.run import load

    run, out, beside = load(options.run), options.out, options.run.resolve()
    if out is None:
        names = (f"{beside.name}-c-{number}" for number in itertools.count(1))
        out = next(folder for name in names if not (folder := beside.parent / name).exists())
    elif (out / "CMakeLists.txt").exists() and not options.overwrite:
        raise InputError(f"the folder {out} already contains an export; choose another --out, or add --overwrite")
    functions = functions_of_run(
        run,
        precision=options.precision,
        names=options.functions,
        iterations=options.iterations,
        temperature=options.temperature,
    )
    casadi: bool | list[str] = options.casadi
    if casadi and not options.functions:  # NAME_casadi.c has first and second derivatives of its functions
        casadi = [name for name in functions if not name.endswith(("_jacobian", "_gradient", "_hessian"))]
    paths = export_c(
        functions,
        out,
        name=options.name,
        casadi=casadi,
        finite=options.finite,
        leave_out_large=options.functions is None,
        overwrite=options.overwrite,
    )
    print(f"{out}: {', '.join(path.name for path in paths)}")
    for path in paths:
        for line in path.read_text().splitlines():
            if line.startswith(" * Left out: "):
                print(line[3:])
