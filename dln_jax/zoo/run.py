"""A trained run from its folder: the model, its parameters, and the jitted functions that they give."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.files import is_file
from dln_jax.mechanics import equations
from dln_jax.mechanics.dynamics import Dynamics, Flow, PlainDynamics, PlainFlow
from dln_jax.mechanics.plain import InverseForward, PhaseRates
from dln_jax.models.latent_phase import LatentPhase
from dln_jax.models.model import Model, Parameters
from dln_jax.models.uncertainty import Uncertainty, outside, predictive
from dln_jax.precision import data_type, require_double_precision
from dln_jax.types import InputError, VectorLike
from dln_jax.zoo.descriptions import OWN, Description, build
from dln_jax.zoo.differential_network import Derivatives, FunctionModel
from dln_jax.zoo.parameter_files import MODEL, REMEDY, load_manifest, load_tree, require_fitting, save_tree
from dln_jax.zoo.pictures import PictureModel
from dln_jax.zoo.uncertainty_files import discard_uncertainty, load_uncertainty

Functions = TypeVar("Functions", bound=Dynamics | PlainDynamics | Flow | PlainFlow)
AnyModel = Model | FunctionModel | PictureModel


# No NamedTuple: functions that are asked for twice have to be the same, or they would be compiled twice.
@dataclass(frozen=True, eq=False)
class Run:
    """A trained model. Its functions are jitted, take one state, as arrays or lists of numbers, and compute in the
    precision of the training. To train on, to differentiate by parameters or to build on the model, take `model` and
    `parameters`: `mechanics.equations.dynamics(run.model.energies(parameters))`.
    """

    model: AnyModel
    """The pair of pure functions: of a mechanical system, of a function, or of pictures."""
    parameters: Parameters
    """Of the model."""
    description: Description
    """What builds the model."""
    uncertainty: Uncertainty | None = None
    """What the model does not know, where the run has it."""

    @functools.cached_property
    def energies(self) -> Any:
        """One of `mechanics.equations.System`, not jitted. InputError for a model of no mechanics."""
        return self._of("energies", Model).energies(self.parameters)

    @functools.cached_property
    def dynamics(self) -> Dynamics | PlainDynamics:
        """Functions of coordinates and velocities. InputError for a model that has none."""
        if isinstance(self.energies, PhaseRates):
            raise self._refusal("dynamics")
        return compiled(equations.dynamics(self.energies, degrees_of_freedom=self._degrees_of_freedom), self.dtype)

    @functools.cached_property
    def flow(self) -> Flow | PlainFlow:
        """Functions of coordinates and momenta, without applied forces. InputError for a model that has none."""
        if isinstance(self.energies, InverseForward):
            raise self._refusal("flow")
        return compiled(equations.flow(self.energies, degrees_of_freedom=self._degrees_of_freedom), self.dtype)

    @functools.cached_property
    def derivatives(self) -> Callable[[VectorLike], Derivatives]:
        """x [n] -> value, Jacobian and Hessian. InputError for a model that is not a differential network."""
        return _jitted(self._of("derivatives", FunctionModel).derivatives(self.parameters), self.dtype)

    @functools.cached_property
    def pictures(self) -> LatentPhase:
        """Encoder, decoder, and the flow of the latent plane. InputError for a model that is not of pictures."""
        system = self._of("pictures", PictureModel).pictures(self.parameters)
        encode, decode = (_jitted(function, self.dtype) for function in (system.encode, system.decode))
        return LatentPhase(encode, decode, compiled(system.field, self.dtype))

    @functools.cached_property
    def torque_std(self) -> Callable[[VectorLike, VectorLike, VectorLike], Array]:
        """(q, qd, qdd) -> standard deviation [d] of a measured torque about the model's, N m or N.

        InputError for a run that has none.
        """
        factor, noise, inflation, _ = self._known_uncertainty
        return _jitted(predictive(self._of("torque_std", Model), self.parameters, factor, noise, inflation), self.dtype)

    @functools.cached_property
    def outside(self) -> Callable[[VectorLike, VectorLike, VectorLike], Array]:
        """(q, qd, qdd) -> whether the state is outside the training data. InputError for a run that cannot tell."""
        uncertainty = self._known_uncertainty
        return _jitted(outside(self._of("outside", Model), self.parameters, uncertainty), self.dtype)

    @property
    def _known_uncertainty(self) -> Uncertainty:
        if self.uncertainty is None:
            raise InputError(
                "the run does not say what its model does not know: train it anew by train_delan, or store an "
                "estimate of learning.uncertainty by save_uncertainty"
            )
        return self.uncertainty

    @property
    def dtype(self) -> Any:
        """Of the training."""
        return data_type(self.description["precision"])

    @property
    def _degrees_of_freedom(self) -> int | None:
        needs = self.description.get("needs")
        return None if needs is None else len(needs["joints"])

    def _of(self, asked: str, kind: type) -> Any:
        if not isinstance(self.model, kind):
            raise self._refusal(asked)
        return self.model

    def _refusal(self, asked: str) -> InputError:
        if isinstance(self.model, FunctionModel):
            given = ".derivatives"
        elif isinstance(self.model, PictureModel):
            given = ".pictures"
        else:
            plain = {PhaseRates: ".flow", InverseForward: ".dynamics"}
            given = plain.get(type(self.energies), ".dynamics or .flow")
        return InputError(f"a {self.description['name']} has no {asked}; ask for {given}")


def save_model(
    directory: str | Path, description: Description, parameters: Parameters, *, overwrite: bool = False
) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder, which `load` reads; `dln_jax.save`.

    Args:
        directory: of the run.
        description: as `describe` gives it.
        parameters: of the model that it describes.
        overwrite: replace the model that the folder has, and forget the uncertainty of its parameters.

    Raises:
        InputError: no such folder, one that has a model, or parameters of another model.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; create it first")
    if is_file(directory / f"{MODEL}.json") and not overwrite:
        raise InputError(f"{directory} has a model already; choose another folder, or give overwrite=True")
    save(directory, description, parameters)


def save(directory: str | Path, description: Description, parameters: Parameters) -> None:
    """As `save_model`, into the folder of a run that is being trained, whose model is replaced.

    Raises:
        InputError: parameters of another model.
    """
    name = description.get("name")
    if name == OWN or ":" in str(name):
        like = jax.tree.map(np.asarray, parameters)  # of a factory that only the user has
    else:
        like = jax.eval_shape(build(description).init, jax.random.key(0))
    require_fitting(parameters, like)
    discard_uncertainty(Path(directory))
    save_tree(Path(directory), MODEL, parameters, {"model": description})


def load(directory: str | Path, *, factory: Callable[..., Any] | None = None, trust: bool = False) -> Run:
    """The trained run in a folder.

    Args:
        directory: what a training command, or `save`, has written.
        factory: that of a model of one's own.
        trust: import the factory of one's own that the file names. Give it for files that you have written: importing
            runs code.

    Raises:
        InputError: no model in the folder, one that is damaged, altered or of another schema, a factory of one's own
            that was neither given nor trusted, or a model in double precision while JAX computes in single: the message
            names the line to add.
    """
    directory = Path(directory)
    description = read_description(directory)
    if description.get("precision") == "f64":
        require_double_precision(str(directory))
    try:
        model = build(description, factory=factory, trust=trust)
    except InputError as error:
        raise InputError(f"{directory / MODEL}.json: {error}") from None
    like = jax.eval_shape(model.init, jax.random.key(0))
    parameters = load_tree(directory, MODEL, like)
    parameters = jax.tree.map(lambda leaf, as_built: leaf.astype(as_built.dtype), parameters, like)
    return Run(model, parameters, description, load_uncertainty(directory))


def read_description(directory: Path) -> Description:
    """The description in a run's folder; `InputError` if there is none."""
    description = load_manifest(directory, MODEL).get("model")
    if not isinstance(description, dict):
        raise InputError(f"{directory / MODEL}.json: describes no model; {REMEDY}")
    return description


def compiled(functions: Functions, dtype: Any) -> Functions:
    """The same functions, jitted, with numbers in their arguments converted to one type."""
    return type(functions)(*(_jitted(function, dtype) for function in functions))


def _jitted(function: Callable[..., Any], dtype: Any) -> Any:
    def convert(leaf):
        # What is no real number stays as it is, for the function to refuse.
        kinds = (jnp.floating, jnp.integer)
        return leaf.astype(dtype) if any(jnp.issubdtype(leaf.dtype, kind) for kind in kinds) else leaf

    @jax.jit
    @functools.wraps(function)
    def call(*state, **named):
        state, named = jax.tree.map(convert, (state, named))
        return function(*state, **named)

    return call
