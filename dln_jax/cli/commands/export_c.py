"""Export the model of a run as C99 source without dependencies: header, source, a demo, and a CMake file.

The run is one of the training commands'. Functions of one state, in SI units: inverse and forward dynamics, gravity,
Coriolis force, friction, mass matrix and energy of a model of dynamics, an integrator's step x_next = F(x, u, dt), and
the exact derivatives of each; rates and steps of a model of a phase space; value, Jacobian and Hessian of a
differential network. Without --functions all that the model has, but for what takes long to compile. There is no
allocation and no state outside the stack. dln_jax.load_c compiles and calls the result from Python;
dln_jax.export_c exports any other JAX function.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.cli.arguments import Unstated
from dln_jax.export.c.run import export_run
from dln_jax.mechanics.discrete import ITERATIONS


@dataclass(frozen=True)
class Arguments:
    """What to export, and where."""

    run: Path
    """Folder of a training run, with model.json and model.safetensors."""
    out: Path
    """Folder for NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt; created where it is missing."""
    functions: Unstated[tuple[str, ...]] = None
    """Names, such as inverse_dynamics step_rk4_jacobian (default: all; a wrong name lists them)."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """float or double (default: that of the training)."""
    name: str = "model"
    """A C name; files and functions start with it."""
    iterations: int = ITERATIONS
    """Newton steps of the implicit midpoint rule."""
    libm: bool = False
    """Call exp, expm1, tanh, sin, cos, log and log1p of the C library, in place of ones that vectorise."""
    casadi: bool = False
    """Add NAME_casadi.c, the functions with exact derivatives for CasADi's external and for acados."""
    overwrite: bool = False
    """Replace the files of an earlier export; those of a run are never replaced."""


def main(given: Arguments) -> None:
    """Exports the model, and prints the files and the functions left out."""
    paths = export_run(
        given.run,
        given.out,
        functions=given.functions,
        name=given.name,
        precision=given.precision,
        iterations=given.iterations,
        libm=given.libm,
        casadi=given.casadi,
        overwrite=given.overwrite,
    )
    print(f"{given.out}: {', '.join(path.name for path in paths)}")
    for path in paths:
        if path.suffix in (".h", ".c"):
            left_out = [line for line in path.read_text().splitlines() if line.startswith(" * Left out: ")]
            print(*(line[3:] for line in left_out), sep="\n", end="\n" * bool(left_out))
