"""The columns of a model that is linear in its parameters: what each is called, and what values it may have.

A model states both by its parameters alone: a leaf `inertias` [links, 10] are the inertial parameters of bodies, every
other leaf has an entry for each joint and is called by its own name. So a law of friction that a model gains has its
columns here without a further word.
"""

from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.mechanics.trees.inertia import PARAMETERS
from dln_jax.models.model import Parameters

Kind = Literal["inertia", "positive", "signed"]
BODIES = "inertias"
"""Name of the leaf with bodies, ten columns each."""
SIGNED = ("offset",)
"""Names of leaves whose entries may have either sign."""


class Columns(NamedTuple):
    """P parameters in the order of the model's leaves."""

    names: tuple[str, ...]
    """As "I_xx_3" or "viscous_2", joints counted from 1."""
    kinds: tuple[Kind, ...]
    """Ten of "inertia" for each body, "positive" for armature and friction, "signed" for what may have either sign."""
    joints: tuple[int, ...]
    """That each belongs to, counted from 0."""


def columns_of(parameters: Parameters) -> Columns:
    """The columns of a model with such parameters; what is no tree's has its leaf's name and its place in it."""
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
    """All parameters end to end, in the order of the columns."""
    leaves: list[Any] = [np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(parameters)]
    return np.concatenate(leaves)
