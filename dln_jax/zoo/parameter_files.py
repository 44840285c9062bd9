"""Stores parameter trees and uncertainties: tensors as safetensors, metadata as JSON. Reading them never runs code.

The manifest stores the name and the SHA-256 of its tensor file, so a truncated, swapped or edited file is refused. Both
files are written beside the old ones and then renamed, the manifest last: a reader sees the old pair or the new one.
"""

import hashlib
import importlib.metadata
import reprlib
from pathlib import Path
from typing import Annotated, Any, TypedDict

import jax
import msgspec
import numpy as np
import safetensors.numpy

from dln_jax.files import as_type, is_file, read_json, write_bytes, write_json
from dln_jax.models.uncertainty import Domain, Uncertainty
from dln_jax.precision import data_type
from dln_jax.types import InputError

MODEL = "model"
"""Stem of the two files that hold the trained model in a run folder."""
VALUE = "value"
"""Stem of the two files that hold a value function."""
UNCERTAINTY = "uncertainty"
"""Stem of the two files that hold the uncertainty of the model in the same folder."""
SCHEMA_VERSION = 2
REMEDY = "restore the file or train again"


class Shape(TypedDict):
    """Shape of a stored tensor."""

    shape: list[Annotated[int, msgspec.Meta(ge=0)]]


class Manifest(msgspec.Struct):
    """Entries of every manifest."""

    schema_version: int
    tensor_file: str
    sha256: str
    tensors: dict[str, Shape]


def save_tree(directory: Path, name: str, tree: Any, facts: dict[str, Any], *, number: int | None = None) -> None:
    """Writes `name.json` and its tensor file, `name.safetensors` or, numbered, `name-NUMBER.safetensors`.

    Numbered files never replace one another, so even a kill between the two renames leaves a consistent pair. The
    tensor file of the previous manifest is removed afterwards.

    Args:
        directory: an existing folder.
        name: stem of the pair.
        tree: any pytree of arrays.
        facts: JSON values to store in the manifest with versions, shapes and digest.
        number: distinguishes successive states of one run.
    """
    # safetensors writes raw memory and reads it in row-major order.
    tensors = {key: np.asarray(leaf, order="C") for key, leaf in _flatten(tree).items()}
    data = safetensors.numpy.save(tensors)
    file_name = f"{name}.safetensors" if number is None else f"{name}-{number:09d}.safetensors"
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "tensor_file": file_name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "tensors": {key: {"shape": list(a.shape), "dtype": str(a.dtype)} for key, a in tensors.items()},
        "versions": {package: importlib.metadata.version(package) for package in ("dln-jax", "jax", "dm-haiku")},
        **facts,
    }
    write_bytes(directory / file_name, data)
    write_json(directory / f"{name}.json", manifest)
    if number is not None:
        for old in directory.glob(f"{name}-*.safetensors"):
            if old.name != file_name:
                old.unlink()


def require_fitting(tree: Any, like: Any, *, kinds: str = "fiu") -> None:
    """Raises `InputError` unless a tree has arrays of these kinds with the names, shapes and dtypes of `like`."""
    own, expected = _flatten(tree), _flatten(like)
    if different := sorted(set(own) ^ set(expected)):
        state = "unknown" if different[0] in own else "missing"
        raise InputError(f"the parameters belong to another model: '{different[0]:.80}' is {state}")
    for key, array in expected.items():
        if not isinstance(own[key], np.ndarray | jax.Array | np.generic) or own[key].dtype.kind not in kinds:
            raise InputError(f"parameter '{key}' is {reprlib.repr(own[key])}; expected an array of real numbers")
        shape, dtype = np.shape(own[key]), own[key].dtype
        if shape != array.shape or dtype != array.dtype:
            raise InputError(f"parameter '{key}' is {dtype} {shape}; expected {array.dtype} {array.shape}")


def load_manifest(directory: Path, name: str) -> dict[str, Any]:
    """Reads the manifest `name.json`; `InputError` if it is missing, malformed, or has another schema version."""
    path = directory / f"{name}.json"
    if not is_file(path):
        raise InputError(f"{path}: no such file; give the folder of a finished run")
    manifest = read_json(path, remedy=REMEDY)
    if manifest.get("schema_version") != SCHEMA_VERSION:
        version = reprlib.repr(manifest.get("schema_version"))
        raise InputError(f"{path}: schema version {version}; expected {SCHEMA_VERSION}; {REMEDY}")
    stated = as_type(manifest, Manifest, name=str(path), remedy=REMEDY)
    if Path(stated.tensor_file).name != stated.tensor_file:
        raise InputError(f"{path}: tensor_file is {stated.tensor_file!r:.60}, expected a name in that folder; {REMEDY}")
    return manifest


def load_tree(directory: Path, name: str, like: Any) -> Any:
    """Reads the stored tree into the structure of `like`.

    Raises:
        InputError: a file is missing, truncated or altered, or its tensors do not fit `like`.
    """
    manifest = load_manifest(directory, name)
    path = directory / manifest["tensor_file"]
    if not is_file(path):
        raise InputError(f"{path}: missing, though {name}.json names it; restore it or train again")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); restore it or train again") from error
    if hashlib.sha256(data).hexdigest() != manifest.get("sha256"):
        raise InputError(f"{path}: truncated or altered (its SHA-256 is not {name}.json's); restore or train again")
    try:
        tensors = safetensors.numpy.load(data)
    except Exception as error:  # the decoder's own errors, and NumPy's for unknown types
        raise InputError(f"{path}: not a safetensors file ({error}); restore it or train again") from error
    try:
        require_fitting(tensors, like, kinds="fiub")
    except InputError as error:
        raise InputError(f"{path}: {error}; load it with the settings and precision it was written with") from None
    # Copied, because JAX cannot donate arrays that share the bytes of the file.
    leaves = [jax.numpy.array(tensors[key]) for key in _flatten(like)]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def save_uncertainty(directory: str | Path, uncertainty: Uncertainty, **facts: Any) -> None:
    """Stores the uncertainty of the model in a run's folder, in the precision of the model.

    Args:
        uncertainty: uncertainty of the model's parameters, from `learning.uncertainty.estimate`.
        facts: JSON values that record how it was estimated.

    Raises:
        InputError: the folder has no model, or the number of parameters differs.
    """
    directory = Path(directory)
    manifest = load_manifest(directory, MODEL)
    P, own = sum(int(np.prod(tensor["shape"])) for tensor in manifest["tensors"].values()), len(uncertainty.factor)
    if own != P:
        raise InputError(
            f"the uncertainty has {own} parameters, but the model in {directory} has {P}; estimate it for that model"
        )
    dtype = data_type(str(manifest["model"]["precision"]))
    stored = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), uncertainty)
    save_tree(directory, UNCERTAINTY, stored, {"of": manifest["sha256"], "facts": facts})


def load_uncertainty(directory: Path) -> Uncertainty | None:
    """Loads the uncertainty stored beside a run's model; `None` if there is none.

    Raises:
        InputError: it is damaged, or belongs to other parameters.
    """
    path = directory / f"{UNCERTAINTY}.json"
    if not is_file(path):
        return None
    manifest, of = load_manifest(directory, UNCERTAINTY), load_manifest(directory, MODEL)
    if manifest.get("of") != of.get("sha256"):
        raise InputError(f"{path}: belongs to other parameters than the model beside it; delete it, {REMEDY}")
    try:
        stated = {key: tuple(tensor["shape"]) for key, tensor in manifest["tensors"].items()}
        (P, K), (d,), u = stated["factor"], stated["noise"], stated["domain/undetermined"][1]
        dtype = data_type(str(of["model"]["precision"]))
    except (KeyError, TypeError, ValueError, IndexError):
        raise InputError(f"{path}: does not state its arrays; {REMEDY}") from None
    domain = Domain((d,), (P,), (P, u), (3 * d,), (3 * d,), (d,))
    shapes = Uncertainty((P, K), (d,), (d,), domain)
    like = jax.tree.map(
        lambda shape: jax.ShapeDtypeStruct(shape, dtype),
        shapes,
        is_leaf=lambda leaf: type(leaf) is tuple,
    )
    return load_tree(directory, UNCERTAINTY, like)


def _flatten(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
