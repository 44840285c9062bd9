"""A trained differential network as one jitted function."""

import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import Array
from jaxtyping import Float

from dln_jax.files import matches
from dln_jax.mechanics.arguments import vectors
from dln_jax.nn import differential_mlp, ensembles
from dln_jax.nn.activations import activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.precision import data_type, require_double_precision
from dln_jax.types import MOST_LAYERS, InputError, VectorLike
from dln_jax.zoo.load import MODEL
from dln_jax.zoo.parameter_files import REMEDY, load_manifest, load_tree, save_tree

KIND = "differential-mlp"
KEYS = {"kind", "sizes", "activation", "members", "precision"}


class Derivatives(NamedTuple):
    """What the function returns at one x [n]; of an ensemble, the means over its members."""

    value: Float[Array, "m"]
    jacobian: Float[Array, "m n"]
    hessian: Float[Array, "m n n"]


class LoadedFunction(NamedTuple):
    """A network, or an ensemble of them, read from a run folder."""

    layers: Layers
    """With the members on the leading axis, also when there is one."""
    description: dict[str, Any]
    """Of the model, as it was saved."""
    derivatives: Callable[[VectorLike], Derivatives]
    """Jitted: x [n] -> value, Jacobian and Hessian, in the precision of the training; refuses what is no such x."""


def save_function(directory: Path, layers: Layers, *, activation: str, precision: str) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder.

    `layers` have the members of the ensemble on their leading axis, also when there is one.
    """
    members = layers[0][0].shape[0]
    sizes = [layers[0][0].shape[1], *(weight.shape[2] for weight, _ in layers)]
    description = dict(kind=KIND, sizes=sizes, activation=activation, members=members, precision=precision)
    save_tree(directory, MODEL, layers, {"model": description})


def check_description(directory: Path, description: dict[str, Any]) -> None:
    """Raises `InputError` unless the description in a folder's model.json is one that `save_function` writes."""
    path = directory / f"{MODEL}.json"
    if missing := KEYS - set(description):
        raise InputError(f"{path}: lacks {', '.join(sorted(missing))}; {REMEDY}")
    for key, hint in (("activation", str), ("precision", str), ("members", int)):
        if not matches(description[key], hint):
            raise InputError(f"{path}: {key} is {reprlib.repr(description[key])}, expected {hint.__name__}; {REMEDY}")
    sizes, members = description["sizes"], description["members"]
    right = isinstance(sizes, list) and 2 <= len(sizes) <= MOST_LAYERS + 2
    if not right or not all(matches(size, int) and size > 0 for size in (*sizes, members)):
        raise InputError(f"{path}: sizes are {reprlib.repr(sizes)} of {members} members, expected numbers; {REMEDY}")


def load_function(directory: str | Path) -> LoadedFunction:
    """The differential network of a trained run.

    Raises:
        InputError: no such model in the folder, one that is damaged, altered or of another schema, or one in double
            precision while JAX computes in single: the message names the line to add.
    """
    directory = Path(directory)
    description = load_manifest(directory, MODEL).get("model")
    if not isinstance(description, dict) or description.get("kind") != KIND:
        raise InputError(f"{directory / MODEL}.json: describes no {KIND}; give the folder of a train_diffnet run")
    check_description(directory, description)
    if description["precision"] == "f64":
        require_double_precision(str(directory))
    dtype, function = data_type(description["precision"]), activation(description["activation"])
    like = jax.eval_shape(
        lambda key: ensembles.init(key, description["sizes"], members=description["members"], dtype=dtype),
        jax.random.key(0),
    )
    layers = load_tree(directory, MODEL, like)

    @jax.jit
    def derivatives(x):
        x = vectors(description["sizes"][0], x=x)[0].astype(dtype)
        every = jax.vmap(lambda ours: differential_mlp.value_jacobian_and_hessian(ours, x, activation=function))(layers)
        return Derivatives(*(array.mean(axis=0) for array in every))

    return LoadedFunction(layers, description, derivatives)
