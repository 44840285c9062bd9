"""Value functions in run folders, with their plants."""

import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.own_plants import OwnProblem, own_plant
from dln_jax.control.optimal.problem import ControlProblem, ValueAndGradient, hjb_policy
from dln_jax.control.optimal.value_networks import ValueNetwork, value_network
from dln_jax.control.state_space import Law
from dln_jax.files import as_type
from dln_jax.mechanics import equations
from dln_jax.models.model import Parameters
from dln_jax.nn.activations import activation
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import REMEDY, VALUE, load_manifest, load_tree, save_tree

SETTINGS = {"widths": tuple[int, ...], "members": int, "activation": str, "floor": float, "scale": float}
"""Arguments of `value_network` stored in value.json, and their types."""


@dataclass(frozen=True, eq=False)
class ValueRun:
    """A value function with its plant."""

    name: str
    """Name of the plant, or its file or folder."""
    problem: ControlProblem
    """The control problem: dynamics and cost."""
    own: OwnProblem
    """The problem as numbers, without functions."""
    network: ValueNetwork
    parameters: Any

    @functools.cached_property
    def value_and_gradient(self) -> ValueAndGradient:
        """x [n] -> V and V_x [n], jitted."""
        return jax.jit(lambda x: self.network.value_and_gradient(self.parameters, x))

    @functools.cached_property
    def law(self) -> Law:
        """x [n] -> u [m], jitted; NaN for a state that is not finite."""
        return jax.jit(hjb_policy(self.value_and_gradient, self.problem))


def plant_of_model(model: Any, parameters: Parameters, problem: OwnProblem) -> ControlProblem:
    """Returns the control problem of a learned or identified `Model` of joints."""
    # Value iteration in float32 converts NumPy's float64 arrays to float32, but not JAX's.
    energies = model.energies(jax.tree.map(np.asarray, parameters))
    return own_plant(equations.dynamics(energies, degrees_of_freedom=len(problem.joints)), problem)


def network_of(problem: ControlProblem, settings: Mapping[str, Any]) -> ValueNetwork:
    """Returns the value network with these `SETTINGS`."""
    return value_network(problem, **{**settings, "activation": activation(settings["activation"])})


def save_value(folder: Path, plant: str, settings: Mapping[str, Any], parameters: Any, own: OwnProblem) -> None:
    """Writes value.json and value.safetensors; the model of the plant is saved by `zoo.run.save`."""
    facts = {
        "plant": plant,
        "network": settings,
        "dtype": str(jax.tree.leaves(parameters)[0].dtype),
        "own": dataclasses.asdict(own),
    }
    save_tree(folder, VALUE, parameters, facts)


def load_value(folder: Path, model: Any, parameters: Parameters) -> ValueRun:
    """Loads the value function in a folder; the plant is the model stored beside it.

    Raises:
        InputError: there is none, or its files are damaged or come from another release.
    """
    path, manifest = folder / f"{VALUE}.json", load_manifest(folder, VALUE)

    def stated(key: str, kind: Any, facts: Mapping[str, Any] = manifest) -> Any:
        return as_type(facts.get(key), kind, name=f"{path}: {key}", remedy=REMEDY)

    name, own = stated("plant", str), stated("own", OwnProblem)
    dtype, facts = jnp.dtype(stated("dtype", Literal["float32", "float64"])), stated("network", dict[str, Any])
    settings = {key: stated(key, kind, facts) for key, kind in SETTINGS.items()}
    try:
        problem = plant_of_model(model, parameters, own)
        network = network_of(problem, settings)
    except InputError as error:
        raise InputError(f"{path}: {error}; {REMEDY}") from None

    def like(key: Array) -> Any:
        return jax.tree.map(lambda leaf: leaf.astype(dtype), network.init(key))

    stored = load_tree(folder, VALUE, jax.eval_shape(like, jax.random.key(0)))
    return ValueRun(name, problem, own, network, stored)
