"""Columns of a model that is linear in its parameters: their names and admissible values.

Both follow from the model's parameters. The leaf `inertias` [links, 10] holds the inertial parameters of the bodies;
every other leaf has one entry per joint and gives its name to its columns. A new friction law therefore needs no change
here.
"""

from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.mechanics.trees.inertia import PARAMETERS
from dln_jax.models.model import Parameters

Kind = Literal["inertia", "positive", "signed"]
BODIES = "inertias"
"""Name of the leaf with the inertial parameters, ten columns per body."""
SIGNED = ("offset",)
"""Endings of the names of leaves whose entries may have either sign."""


class Columns(NamedTuple):
    """Columns of P parameters in the order of the model's leaves."""

    names: tuple[str, ...]
    """Names such as "I_xx_3" or "viscous_2", joints counted from 1."""
    kinds: tuple[Kind, ...]
    """"inertia" for the ten columns of a body, "positive" for armature and friction, "signed" for either sign."""
    joints: tuple[int, ...]
    """Joint of every column, counted from 0."""


def columns_of(parameters: Parameters) -> Columns:
    """Columns of a model with these parameters; outside `inertias` a column is named by its leaf and place in it."""
    names: list[str] = []
    kinds: list[Kind] = []
    joints: list[int] = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(parameters)[0]:
        name = "_".join(str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", key)))) for key in path)
        shape = np.shape(leaf)
        bodies = name == BODIES and len(shape) == 2 and shape[1] == len(PARAMETERS)
        kind: Kind = "inertia" if bodies else "signed" if name.endswith(SIGNED) else "positive"
        for place in range(int(np.prod(shape))):
            joint, which = divmod(place, len(PARAMETERS)) if bodies else (place, 0)
            names.append(f"{PARAMETERS[which] if bodies else name}_{joint + 1}")
            kinds.append(kind)
            joints.append(joint)
    return Columns(tuple(names), tuple(kinds), tuple(joints))


def flat(parameters: Parameters) -> Float[np.ndarray, " P"]:
    """Concatenates all parameters in the order of the columns."""
    leaves: list[Any] = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(parameters)]
    return np.concatenate(leaves)
