"""A trained run as jitted functions."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from dln_jax.data.schema import needs_from_json
from dln_jax.learning.checkpoints import load_manifest, load_tree, save_tree
from dln_jax.learning.train import data_type
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.models.delan import make_delan
from dln_jax.models.model import Model, Parameters
from dln_jax.nn.activations import activation
from dln_jax.types import InputError

MODEL = "model"
"""Name of the file pair in a run's folder that holds the trained model."""


def build(description: dict[str, Any]) -> Model:
    """The model that a description, plain JSON values, stands for.

    Keys: `kind` ("structured-delan"), `needs`, `width`, `depth`, `activation`, `diagonal_shift`, `diagonal_floor` and
    `precision` (f32 or f64).

    Raises:
        InputError: an unknown kind, needs, activation or precision, or a missing or unknown key.
    """
    settings = dict(description)
    kind = settings.pop("kind", None)
    if kind != "structured-delan":
        raise InputError(f"model kind is {kind!r}; this release knows structured-delan")
    try:
        return make_delan(
            needs_from_json(settings.pop("needs")),
            activation=activation(settings.pop("activation")),
            dtype=data_type(settings.pop("precision")),
            **settings,
        )
    except (KeyError, TypeError) as error:
        raise InputError(f"model description: {error}; a release that is newer or older may have written it") from error


def save_model(directory: Path, description: dict[str, Any], parameters: Parameters) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder."""
    save_tree(directory, MODEL, parameters, {"model": description})


def load_run(directory: str | Path) -> Dynamics:
    """The jitted dynamics of a trained run, its parameters closed over.

    Each function takes one state as NumPy or JAX arrays [d] and computes in the precision of the training.

    Raises:
        InputError: no model in the folder, or one that is damaged, altered or of another schema.
    """
    directory = Path(directory)
    description = load_manifest(directory, MODEL).get("model")
    if not isinstance(description, dict):
        raise InputError(f"{directory / MODEL}.json: describes no model; train again or restore the file")
    model = build(description)
    dtype = data_type(description["precision"])
    like = jax.eval_shape(model.init, jax.random.key(0))
    return compiled(model.apply(load_tree(directory, MODEL, like)), dtype)


def compiled(dynamics: Dynamics, dtype) -> Dynamics:
    """The same functions, jitted, with their arguments converted to one type."""

    def convert_and_call(function):
        return jax.jit(lambda *state: function(*(jnp.asarray(array, dtype) for array in state)))

    return Dynamics(*map(convert_and_call, dynamics))
