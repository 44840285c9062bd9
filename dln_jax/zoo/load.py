"""A trained run as jitted functions: dynamics (train_delan, train_hnn), or a phase field (train_hnn --task)."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.flow import Flow, PlainFlow
from dln_jax.models.model import Parameters
from dln_jax.precision import data_type, require_double_precision
from dln_jax.types import InputError
from dln_jax.zoo.kinds import build
from dln_jax.zoo.parameter_files import load_manifest, load_tree, save_tree
from dln_jax.zoo.phase_kinds import build_phase

Functions = TypeVar("Functions", bound=Dynamics | PlainDynamics | Flow | PlainFlow)

MODEL = "model"
"""Name of the file pair in a run's folder that holds the trained model."""


def save_model(directory: Path, description: dict[str, Any], parameters: Parameters) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder."""
    save_tree(directory, MODEL, parameters, {"model": description})


def load_run(directory: str | Path) -> Dynamics | PlainDynamics:
    """The jitted dynamics of a trained run, its parameters closed over.

    Each function takes one state, as arrays or lists of d numbers, and computes in the precision of the training.

    Raises:
        InputError: no model in the folder, one that is damaged, altered or of another schema, or one in double
            precision while JAX computes in single: the message names the line to add.
    """
    model, parameters, description = _stored(Path(directory), build)
    system, d = model.energies(parameters), len(description["needs"]["joints"])
    return compiled(dynamics(system, degrees_of_freedom=d), data_type(description["precision"]))


def load_system(directory: str | Path) -> Any:
    """The energies of a trained run, its parameters closed over.

    Raises:
        InputError: as `load_run`.
    """
    model, parameters, _ = _stored(Path(directory), build)
    return model.energies(parameters)


def load_phase_field(directory: str | Path) -> Flow | PlainFlow:
    """The jitted phase field of a run of train_hnn --task, its parameters closed over: rates and energy.

    Raises:
        InputError: as `load_run`, for phase models.
    """
    model, parameters, description = _stored(Path(directory), build_phase)
    system, d = model.energies(parameters), len(description["needs"]["joints"])
    return compiled(flow(system, degrees_of_freedom=d), data_type(description["precision"]))


def compiled(functions: Functions, dtype) -> Functions:
    """The same functions, jitted, with numbers in their arguments converted to one type."""

    def convert(leaf):
        # What is no real number stays as it is, for the function to refuse.
        kinds = (jnp.floating, jnp.integer)
        return leaf.astype(dtype) if any(jnp.issubdtype(leaf.dtype, kind) for kind in kinds) else leaf

    def convert_and_call(function) -> Any:
        @jax.jit
        @functools.wraps(function)
        def call(*state, **named):
            state, named = jax.tree.map(convert, (state, named))
            return function(*state, **named)

        return call

    return type(functions)(*map(convert_and_call, functions))


def _stored(directory: Path, build: Callable[[dict[str, Any]], Any]) -> tuple[Any, Parameters, dict[str, Any]]:
    """The model of a folder, its parameters and its description."""
    description = load_manifest(directory, MODEL).get("model")
    if not isinstance(description, dict):
        raise InputError(f"{directory / MODEL}.json: describes no model; train again or restore the file")
    if description.get("precision") == "f64":
        require_double_precision(str(directory))
    try:
        model = build(description)
    except InputError as error:
        raise InputError(f"{directory / MODEL}.json: {error}") from None
    like = jax.eval_shape(model.init, jax.random.key(0))
    return model, load_tree(directory, MODEL, like), description
