"""Trees as JSON values, for storage in a run."""

import reprlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from dln_jax.mechanics.trees.description import Tree, make_tree
from dln_jax.types import InputError


def tree_to_json(tree: Tree) -> dict[str, Any]:
    """Returns the tree's fields, with numbers as lists in double precision."""
    fields = tree._asdict()
    structure = {name: list(fields.pop(name)) for name in ("parents", "joints", "names")}
    return {**structure, **{name: np.asarray(numbers, float).tolist() for name, numbers in fields.items()}}


def tree_from_json(values: Any) -> Tree:
    """Returns the tree of `tree_to_json`.

    Raises:
        InputError: fields that are missing or unknown, or that `make_tree` refuses.
    """
    if not isinstance(values, Mapping) or set(values) != set(Tree._fields):
        raise InputError(f"tree: expected the fields {', '.join(Tree._fields)}, got {reprlib.repr(values)}")
    try:
        return make_tree(**values)
    except InputError as error:
        raise InputError(f"tree: {error}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"tree: {reprlib.repr(str(error))}; expected numbers, and names of joints") from error
