"""Exports functions as `jax.export` artefacts: StableHLO that any JAX runs without this package.

An artefact is the output of `jax.export` (including platforms and shapes), followed by its SHA-256.
`jax.export.deserialize` ignores the digest; `load_stablehlo` checks it. JAX promises to read artefacts for six months
after the release that wrote them; export older ones again from the run folder. Artefacts are compiled where they are
loaded, for the platforms that they were lowered for. Writing and reading need the package `flatbuffers`.
"""

import contextlib
import hashlib
import importlib.util
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

from dln_jax.export.exports import AGAIN, write_exports
from dln_jax.mechanics.arguments import require_shape
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.precision import require_double_precision
from dln_jax.types import InputError

SUFFIX = ".stablehlo"
DIGEST = hashlib.sha256().digest_size
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
_ARGUMENTS = {"inverse_dynamics": 3, "forward_dynamics": 3, "energy": 2, "mass_matrix": 2}


def export_stablehlo(
    function: Callable[..., Any],
    *examples: Any,
    path: str | Path,
    platforms: Sequence[str] = ("cpu",),
    overwrite: bool = False,
) -> Path:
    """Writes a function, for arguments like the examples, as an artefact, and returns the path.

    Args:
        function: a function of arrays with its parameters closed over.
        examples: one example per argument: an array, a number, or a `jax.ShapeDtypeStruct`.
        path: path of the artefact; must end in .stablehlo.
        platforms: platforms to lower for: cpu, cuda, rocm, tpu.
        overwrite: replace an existing artefact.

    Raises:
        InputError: the ending is wrong, the file exists, the folder belongs to a run, an example is not an array, JAX
            does not know a platform, or `flatbuffers` is missing.
    """
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path} does not end in {SUFFIX}; give the file a name that does")
    files = {path.name: _artefact(function, examples, platforms)}
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
    """Writes those of inverse_dynamics, forward_dynamics, energy and mass_matrix that a model has; returns the paths.

    Args:
        dynamics: functions of one state, such as `load(folder).dynamics`.
        degrees_of_freedom: d.
        directory: folder of the artefacts, created if missing; all are written, or none.
        dtype: dtype of the arguments; float64 needs `jax_enable_x64`.
        platforms, overwrite: as for `export_stablehlo`.

    Raises:
        InputError: as for `export_stablehlo`, or `degrees_of_freedom` is not a positive integer.
    """
    if type(degrees_of_freedom) is not int or degrees_of_freedom < 1:
        raise InputError(f"degrees_of_freedom is {degrees_of_freedom!r}; expected a whole number from 1")
    if jnp.dtype(dtype) == jnp.float64:
        require_double_precision("dtype float64")
    state = jax.ShapeDtypeStruct((degrees_of_freedom,), dtype)
    files = {}
    for name, count in _ARGUMENTS.items():
        if (function := getattr(dynamics, name, None)) is not None:
            files[f"{name}{SUFFIX}"] = _artefact(function, [state] * count, platforms)
    return write_exports(Path(directory), files, overwrite=overwrite)


def load_stablehlo(path: str | Path) -> Callable[..., Any]:
    """Returns the jitted function of an artefact, which takes arrays or lists of numbers of the exported shapes.

    Raises:
        InputError: the file is missing, altered, too old or for other platforms, the artefact is in double precision
            while JAX computes in single, or `flatbuffers` is missing.
    """
    path = Path(path)
    if path.suffix != SUFFIX or not path.is_file():
        raise InputError(f"{path}: no such file; give the {SUFFIX} file that export_stablehlo wrote")
    _require_flatbuffers()
    data = path.read_bytes()
    if hashlib.sha256(data[:-DIGEST]).digest() != data[-DIGEST:]:
        raise InputError(f"{path}: truncated or altered (its SHA-256 is not the one in it); {AGAIN}")
    try:
        exported = export.deserialize(bytearray(data[:-DIGEST]))
    except Exception as error:  # flatbuffers and struct raise exceptions without a common class
        raise InputError(f"{path}: no artefact that JAX {jax.__version__} can read; {AGAIN}") from error
    # A GPU is called "gpu" as a backend, and "cuda" or "rocm" as a platform.
    platform, platforms = export.default_export_platform(), ", ".join(exported.platforms)
    if platform not in exported.platforms:
        raise InputError(f"{path} is for {platforms}, and JAX runs on {platform}; export it with that platform")
    expected = exported.in_avals
    if any(argument.dtype == "float64" for argument in expected):
        require_double_precision(str(path))

    # The checks run while JAX traces, and so once per shape and dtype.
    @jax.jit
    def call(*arguments):
        if len(arguments) != len(expected):
            raise InputError(f"{path} takes ({', '.join(map(str, expected))}), got {len(arguments)} arguments")
        arrays = []
        for number, (argument, like) in enumerate(zip(arguments, expected, strict=True), 1):
            try:
                arrays.append(jnp.asarray(argument, like.dtype))
            except (TypeError, ValueError) as error:
                raise InputError(f"argument {number} is not an array; expected {like}") from error
            require_shape(f"argument {number}", arrays[-1].shape, like.shape)
        return exported.call(*arrays)

    return call


def _require_flatbuffers() -> None:
    if importlib.util.find_spec("flatbuffers") is None:
        raise InputError("jax.export artefacts need the package flatbuffers; install the extra [export]")


def _artefact(function: Callable[..., Any], examples: Sequence[Any], platforms: Sequence[str]) -> bytes:
    """Returns the serialised function, followed by its digest."""
    _require_flatbuffers()
    if isinstance(platforms, str) or not platforms or not set(platforms) <= set(PLATFORMS):
        raise InputError(f"platforms is {platforms!r}; expected a tuple of {', '.join(PLATFORMS)}")
    shapes = [_shape_of(number, example) for number, example in enumerate(examples, 1)]
    data = bytes(export.export(jax.jit(function), platforms=tuple(platforms))(*shapes).serialize())
    return data + hashlib.sha256(data).digest()


def _shape_of(number: int, example: Any) -> jax.ShapeDtypeStruct:
    """Returns the shape of an example, and the dtype of JAX's computation."""
    with contextlib.suppress(TypeError):
        # A list or tuple stays one argument, although JAX would treat it as several.
        if isinstance(shape := jax.eval_shape(lambda x: x, example), jax.ShapeDtypeStruct):
            if isinstance(example, jax.ShapeDtypeStruct) and example.dtype != shape.dtype:
                raise InputError(
                    f"example {number} is {example.dtype}, and JAX computes in {shape.dtype}; set jax_enable_x64"
                )
            return jax.ShapeDtypeStruct(shape.shape, shape.dtype)
    raise InputError(f"example {number} is {example!r:.40}; give an array of numbers")
