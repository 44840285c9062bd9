"""Functions as `jax.export` artefacts: StableHLO with a calling convention, run by any JAX without this package.

Beside each artefact, NAME.json states what it was made with and for, and its digest. JAX promises to read artefacts
for six months after the release that wrote them; an older one is exported again from its run folder. They are compiled
where they are loaded, for the platforms they were lowered for. Writing and reading need the package `flatbuffers`.
"""

import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, export

from dln_jax.export.exports import described, read_export, write_exports
from dln_jax.mechanics.arguments import require_shape
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.precision import require_double_precision
from dln_jax.types import InputError

SUFFIX = ".stablehlo"
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
_ARGUMENTS = {"inverse_dynamics": 3, "forward_dynamics": 3, "energy": 2, "mass_matrix": 2}


def export_stablehlo(
    function: Callable[..., Any],
    *examples: Any,
    path: str | Path,
    platforms: Sequence[str] = ("cpu",),
    overwrite: bool = False,
) -> Path:
    """Writes the function, for arguments like the examples, to a file that ends in .stablehlo, and a note beside it.

    Args:
        function: of arrays, its parameters closed over.
        examples: one argument each: an array, a number, or a `jax.ShapeDtypeStruct`.
        path: of the artefact.
        platforms: what it may run on: cpu, cuda, rocm, tpu.
        overwrite: replace an artefact and its note that exist.

    Raises:
        InputError: another ending, a file that exists, the folder of a run, an example that is no array, a platform
            that JAX does not know, or no `flatbuffers`.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path} does not end in {SUFFIX}; give the file a name that does")
    files = _artefact(path.name, function, examples, platforms)
    return write_exports(path.parent, files, overwrite=overwrite)[0]


def export_dynamics(
    dynamics: Dynamics | PlainDynamics,
    degrees_of_freedom: int,
    directory: str | Path,
    *,
    dtype: Any,
    platforms: Sequence[str] = ("cpu",),
    overwrite: bool = False,
) -> list[Path]:
    """Artefacts inverse_dynamics, forward_dynamics, energy and mass_matrix of a model, as far as it has them.

    Args:
        dynamics: of one state, for instance `load(folder).dynamics`.
        degrees_of_freedom: d.
        directory: is created where it is missing; all artefacts are written, or none.
        dtype: of the arguments; float64 needs `jax_enable_x64`.
        platforms, overwrite: as `export_stablehlo`.

    Raises:
        InputError: as `export_stablehlo`, or degrees of freedom that are no count.
    """
    if type(degrees_of_freedom) is not int or degrees_of_freedom < 1:
        raise InputError(f"degrees_of_freedom is {degrees_of_freedom!r}; expected a whole number from 1")
    if jnp.dtype(dtype) == jnp.float64:
        require_double_precision("dtype float64")
    state = jax.ShapeDtypeStruct((degrees_of_freedom,), dtype)
    files = {}
    for name, count in _ARGUMENTS.items():
        if (function := getattr(dynamics, name, None)) is not None:
            files |= _artefact(f"{name}{SUFFIX}", function, [state] * count, platforms)
    return [path for path in write_exports(Path(directory), files, overwrite=overwrite) if path.suffix == SUFFIX]


def load_stablehlo(path: str | Path) -> Callable[..., Any]:
    """The function of an artefact, jitted; it takes arrays, or lists of numbers, of the exported shapes, and no others.

    Raises:
        InputError: no such file, no note beside it, one that is altered, too old, for other platforms, or in double
            precision while JAX computes in single, or no `flatbuffers`.
    """
    path = Path(path)
    if path.suffix != SUFFIX or not path.is_file():
        raise InputError(f"{path}: no such file; give the {SUFFIX} file that export_stablehlo wrote")
    _require_flatbuffers()
    data = read_export(note_of(path), (path.name,))[1][path.name]
    try:
        exported = export.deserialize(bytearray(data))
    except Exception as error:  # the reader's exceptions are those of flatbuffers and of struct, and of no one class
        raise InputError(f"{path}: no artefact that JAX {jax.__version__} can read; export it again") from error
    # A GPU is "gpu" as a backend, and "cuda" or "rocm" as a platform.
    platform, platforms = export.default_export_platform(), ", ".join(exported.platforms)
    if platform not in exported.platforms:
        raise InputError(f"{path} is for {platforms}, and JAX runs on {platform}; export it with that platform")
    if any(in_aval.dtype == "float64" for in_aval in exported.in_avals):
        require_double_precision(str(path))
    return _refusing(path, exported)


def note_of(path: Path) -> Path:
    """Path of the note beside an artefact."""
    return path.with_suffix(".json")


def _refusing(path: Path, exported: export.Exported) -> Callable[..., Any]:
    """The function, jitted; arguments that are arrays are converted to the exported types, other shapes refused."""
    wanted = exported.in_avals
    plain = exported.in_tree == jax.tree.structure(((0,) * len(wanted), {}))

    def converted(name: str, argument: Any, like: Any) -> Array:
        try:
            array = jnp.asarray(argument, like.dtype)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name} makes no array; expected {like}") from error
        require_shape(name, array.shape, like.shape)
        return array

    # What is refused is refused where JAX traces, that is once for each shape and type.
    @jax.jit
    def call(*arguments):
        if plain and len(arguments) == len(wanted):
            names = (f"argument {number}" for number, _ in enumerate(wanted, 1))
            arguments = list(map(converted, names, arguments, wanted))
        try:
            return exported.call(*arguments)
        except (ValueError, TypeError) as error:
            got = ", ".join(str(getattr(argument, "aval", type(argument).__name__)) for argument in arguments)
            raise InputError(f"{path} takes ({', '.join(map(str, wanted))}), got ({got})") from error

    return call


def _require_flatbuffers() -> None:
    if importlib.util.find_spec("flatbuffers") is None:
        raise InputError("jax.export artefacts need the package flatbuffers; install the extra [export]")


def _artefact(
    name: str, function: Callable[..., Any], examples: Sequence[Any], platforms: Sequence[str]
) -> dict[str, bytes]:
    """The artefact and its note, by file name."""
    _require_flatbuffers()
    if isinstance(platforms, str) or not platforms or not set(platforms) <= set(PLATFORMS):
        raise InputError(f"platforms is {platforms!r}; expected a tuple of {', '.join(PLATFORMS)}")
    shapes = [_shape_of(number, example) for number, example in enumerate(examples, 1)]
    exported = export.export(jax.jit(function), platforms=tuple(platforms))(*shapes)
    note = {
        "jax": jax.__version__,
        "calling_convention_version": exported.calling_convention_version,
        "platforms": list(exported.platforms),
        "arguments": [str(shape) for shape in exported.in_avals],
        "results": [str(shape) for shape in exported.out_avals],
        "reading": "jax.export.deserialize(bytes).call(*arguments); JAX reads it for six months after its release",
    }
    files = {name: bytes(exported.serialize())}
    return {**files, note_of(Path(name)).name: described(note, files)}


def _shape_of(number: int, example: Any) -> jax.ShapeDtypeStruct:
    known = (jax.ShapeDtypeStruct, jax.Array, np.ndarray, np.generic, int, float, complex)
    try:
        # The type that JAX computes in; a list is none, though JAX would take it for several arguments.
        dtype = jnp.result_type(example) if isinstance(example, known) else None
    except TypeError:
        dtype = None
    if dtype is None:
        raise InputError(f"example {number} is {example!r:.40}; give an array of numbers")
    if isinstance(example, jax.ShapeDtypeStruct) and example.dtype != dtype:
        raise InputError(f"example {number} is {example.dtype}, but JAX is set to {dtype}; set jax_enable_x64 first")
    return jax.ShapeDtypeStruct(jnp.shape(example), dtype)
