"""Functions as `jax.export` artefacts: StableHLO with a calling convention, run by any JAX without this package.

Beside each artefact, NAME.json states what it was made with and for. JAX promises to read artefacts for six months
after the release that wrote them; an older one is exported again from its run folder. They are compiled where they are
loaded, for the platforms they were lowered for. Writing and reading need the package `flatbuffers`.
"""

import importlib.util
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from jax import export

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError

SUFFIX = ".stablehlo"


def export_stablehlo(
    function: Callable[..., Any],
    *examples: Any,
    path: str | Path,
    platforms: Sequence[str] = ("cpu",),
    overwrite: bool = False,
) -> Path:
    """Writes the function, for arguments like the examples, to a file that ends in .stablehlo, and a note beside it.

    Raises:
        InputError: another ending, a file that exists, or no `flatbuffers`.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path} does not end in {SUFFIX}; give the file a name that does")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists; choose another path, or overwrite it")
    _require_flatbuffers()
    shapes = [jax.ShapeDtypeStruct(jax.numpy.shape(each), jax.numpy.result_type(each)) for each in examples]
    exported = export.export(jax.jit(function), platforms=tuple(platforms))(*shapes)
    note = {
        "jax": jax.__version__,
        "calling_convention_version": exported.calling_convention_version,
        "platforms": list(exported.platforms),
        "arguments": [str(shape) for shape in exported.in_avals],
        "results": [str(shape) for shape in exported.out_avals],
        "reading": "jax.export.deserialize(bytes).call(*arguments); JAX reads it for six months after its release",
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    for target, data in ((path, bytes(exported.serialize())), (note_of(path), json.dumps(note, indent=2).encode())):
        partial = target.with_name(target.name + ".partial")
        partial.write_bytes(data)
        partial.replace(target)
    return path


def export_dynamics(
    dynamics: Dynamics, degrees_of_freedom: int, directory: str | Path, *, dtype: Any, **keywords: Any
) -> list[Path]:
    """Artefacts inverse_dynamics, forward_dynamics, energy and mass_matrix of a model, as far as it has them.

    Args:
        dynamics: of one state, for instance from `load_run`.
        degrees_of_freedom: d.
        directory: is created where it is missing.
        dtype: of the arguments.
        keywords: of `export_stablehlo`.
    """
    state = jax.ShapeDtypeStruct((degrees_of_freedom,), dtype)
    arguments = {"inverse_dynamics": 3, "forward_dynamics": 3, "energy": 2, "mass_matrix": 2}
    functions = {name: getattr(dynamics, name) for name in arguments}
    return [
        export_stablehlo(function, *[state] * arguments[name], path=Path(directory) / f"{name}{SUFFIX}", **keywords)
        for name, function in functions.items()
        if function is not None
    ]


def load_stablehlo(path: str | Path) -> Callable[..., Any]:
    """The function of an artefact, jitted.

    Raises:
        InputError: no such file, one that is damaged or too old, one for other platforms, or no `flatbuffers`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; give one that export_stablehlo wrote")
    _require_flatbuffers()
    try:
        exported = export.deserialize(bytearray(path.read_bytes()))
    except Exception as error:  # the reader's exceptions are those of flatbuffers and of struct, and of no one class
        raise InputError(f"{path}: no artefact that JAX {jax.__version__} can read; export it again") from error
    if jax.default_backend() not in exported.platforms:
        raise InputError(
            f"{path} is for {', '.join(exported.platforms)}, and JAX runs on {jax.default_backend()}; "
            "export it with that platform"
        )
    return jax.jit(exported.call)


def note_of(path: Path) -> Path:
    """Path of the note beside an artefact."""
    return path.with_suffix(".json")


def _require_flatbuffers() -> None:
    if importlib.util.find_spec("flatbuffers") is None:
        raise InputError("jax.export artefacts need the package flatbuffers; install the extra [export]")
