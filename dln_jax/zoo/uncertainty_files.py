"""Stores the uncertainty of a model in its run folder: `uncertainty.safetensors` and its JSON."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.files import is_file
from dln_jax.models.uncertainty import Domain, Uncertainty
from dln_jax.precision import data_type
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import MODEL, REMEDY, load_manifest, load_tree, save_tree

UNCERTAINTY = "uncertainty"
"""Stem of the pair of files."""


def save_uncertainty(directory: str | Path, uncertainty: Uncertainty, **facts: Any) -> None:
    """Stores the uncertainty of the model in a run's folder, in the precision of the model.

    Args:
        uncertainty: uncertainty of the model's parameters, from `learning.uncertainty.estimate`.
        facts: JSON values on how it was estimated.

    Raises:
        InputError: the folder has no model, or the number of parameters differs.
    """
    directory = Path(directory)
    manifest = load_manifest(directory, MODEL)
    P = _parameters(manifest)
    if np.shape(uncertainty.factor)[0] != P:
        raise InputError(
            f"the uncertainty is of {np.shape(uncertainty.factor)[0]} parameters, and the model in {directory} has "
            f"{P}; estimate it of that model"
        )
    dtype = data_type(str(manifest["model"]["precision"]))
    stored = jax.tree.map(lambda leaf: np.asarray(leaf, dtype), uncertainty)
    save_tree(directory, UNCERTAINTY, stored, {"of": manifest["sha256"], "facts": facts})


def load_uncertainty(directory: Path) -> Uncertainty | None:
    """Loads the uncertainty stored beside a run's model; `None` if there is none.

    Raises:
        InputError: it is damaged, or belongs to other parameters than the model's.
    """
    path = directory / f"{UNCERTAINTY}.json"
    if not is_file(path):
        return None
    manifest, of = load_manifest(directory, UNCERTAINTY), load_manifest(directory, MODEL)
    if manifest.get("of") != of.get("sha256"):
        raise InputError(f"{path}: belongs to other parameters than the model's; delete it, {REMEDY}")
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


def discard_uncertainty(directory: Path) -> None:
    """Removes the stored uncertainty, if any."""
    for ending in ("json", "safetensors"):
        with suppress(OSError):
            (directory / f"{UNCERTAINTY}.{ending}").unlink(missing_ok=True)


def _parameters(manifest: dict[str, Any]) -> int:
    return sum(int(np.prod(tensor["shape"])) for tensor in manifest["tensors"].values())
