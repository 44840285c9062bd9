"""Export the model of a run as C99 source without dependencies: header, source, a demo, and a CMake file.

The run is one of train_delan, train_hnn or train_diffnet. Functions of one state, in SI units: inverse and forward
dynamics, energy and mass matrix of a model of dynamics; value and Jacobian of a differential network. There is no
allocation and no state outside the stack. dln_jax.deploy.c.load compiles and calls the result from Python.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dln_jax.command_line.arguments import Unstated
from dln_jax.deploy.c.source import export_run


@dataclass(frozen=True)
class Arguments:
    """What to export, and where to."""

    run: Path
    """Folder of a training run, with model.json and model.safetensors."""
    out: Path
    """Folder for NAME.h, NAME.c, NAME_demo.c, NAME.json and CMakeLists.txt; created where it is missing."""
    precision: Unstated[Literal["f32", "f64"]] = None
    """float or double (default: that of the training)."""
    name: str = "model"
    """A C name; files and functions start with it."""
    overwrite: bool = False
    """Replace the files of an earlier export; those of a run are never replaced."""


def main(given: Arguments) -> None:
    """Exports, and says what was written."""
    paths = export_run(given.run, given.out, name=given.name, precision=given.precision, overwrite=given.overwrite)
    print(f"{given.out}: {', '.join(path.name for path in paths)}")
