"""A trained run loaded from its folder: the model, its parameters, and jitted functions."""

import functools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.files import is_file
from dln_jax.mechanics import equations
from dln_jax.mechanics.dynamics import Dynamics, Flow, InverseForward, PhaseRates
from dln_jax.models import uncertainty as uncertainties
from dln_jax.models.baselines import Derivatives, FunctionModel
from dln_jax.models.latent_phase import ImageModel, LatentPhase
from dln_jax.models.model import Model, Parameters
from dln_jax.models.uncertainty import Uncertainty, predictive
from dln_jax.precision import data_type, require_double_precision
from dln_jax.types import InputError, VectorLike
from dln_jax.zoo.descriptions import OWN, Description, build
from dln_jax.zoo.parameter_files import (
    MODEL,
    REMEDY,
    UNCERTAINTY,
    VALUE,
    load_manifest,
    load_tree,
    load_uncertainty,
    require_fitting,
    save_tree,
)

if TYPE_CHECKING:
    from dln_jax.zoo.value_functions import ValueRun

Functions = TypeVar("Functions", bound=Dynamics | InverseForward | Flow | PhaseRates)
AnyModel = Model | FunctionModel | ImageModel


# Not a NamedTuple: cached properties return the same function on every access, so it is compiled only once.
@dataclass(frozen=True, eq=False)
class Run:
    """A trained model with jitted functions of one state.

    The functions take arrays or lists of numbers and compute in the precision of the training. To continue training,
    differentiate with respect to parameters, or extend the model, use `model` and `parameters`:
    `mechanics.equations.dynamics(run.model.energies(parameters))`.
    """

    model: AnyModel
    """Pair of pure functions that model a mechanical system, a function, or images."""
    parameters: Parameters
    """Parameters of the model."""
    description: Description
    """Description to build the model from."""
    uncertainty: Uncertainty | None = None
    """Uncertainty of the model, if the run has one."""
    value_function: "ValueRun | None" = None
    """Value function in the folder, if it has one."""

    def __repr__(self) -> str:
        """Shows the name, the number of parameters, and whether the run has an uncertainty."""
        size = sum(np.size(leaf) for leaf in jax.tree.leaves(self.parameters))
        more = "without uncertainty" if self.uncertainty is None else "with uncertainty"
        name, precision = self.description["name"], self.description["precision"]
        return f"{type(self).__name__} of {name}: {size:,} parameters, {precision}\n  {more}"

    @functools.cached_property
    def energies(self) -> Any:
        """The energies (`mechanics.equations.System`), not jitted; `InputError` for a model without mechanics."""
        return self._of("energies", Model).energies(self.parameters)

    @functools.cached_property
    def dynamics(self) -> Dynamics | InverseForward:
        """Functions of coordinates and velocities; `InputError` for a model without them."""
        return self._compiled("dynamics", equations.dynamics, PhaseRates)

    @functools.cached_property
    def flow(self) -> Flow | PhaseRates:
        """Functions of coordinates and momenta, without applied forces; `InputError` for a model without them."""
        return self._compiled("flow", equations.flow, InverseForward)

    @functools.cached_property
    def derivatives(self) -> Callable[[VectorLike], Derivatives]:
        """x [n] -> value, Jacobian and Hessian; `InputError` unless the model is a differential network."""
        return _jitted(self._of("derivatives", FunctionModel).derivatives(self.parameters), self.dtype)

    @functools.cached_property
    def images(self) -> LatentPhase:
        """Encoder, decoder and flow of the latent plane; `InputError` unless the model is for images."""
        system = self._of("images", ImageModel).images(self.parameters)
        encode, decode = (_jitted(function, self.dtype) for function in (system.encode, system.decode))
        return LatentPhase(encode, decode, compiled(system.field, self.dtype))

    @property
    def value(self) -> "ValueRun":
        """Value function with its plant and control law; `InputError` for a run without one."""
        if self.value_function is None:
            raise self._refusal("value")
        return self.value_function

    @functools.cached_property
    def torque_std(self) -> Callable[[VectorLike, VectorLike, VectorLike], Array]:
        """(q, qd, qdd) -> standard deviation [d] of a measured torque, N m or N; `InputError` without uncertainty."""
        factor, noise, inflation, _ = self._known_uncertainty
        return _jitted(predictive(self._of("torque_std", Model), self.parameters, factor, noise, inflation), self.dtype)

    @functools.cached_property
    def out_of_distribution(self) -> Callable[[VectorLike, VectorLike, VectorLike], Array]:
        """(q, qd, qdd) -> whether the state is out of distribution; `InputError` for a run without an uncertainty."""
        uncertainty = self._known_uncertainty
        model = self._of("out_of_distribution", Model)
        return _jitted(uncertainties.out_of_distribution(model, self.parameters, uncertainty), self.dtype)

    @property
    def _known_uncertainty(self) -> Uncertainty:
        if self.uncertainty is None:
            raise InputError(
                "the run has no uncertainty; train it again with train_delan, or estimate one with "
                "learning.uncertainty and store it with save_uncertainty"
            )
        return self.uncertainty

    @property
    def dtype(self) -> Any:
        """Floating-point type of the training."""
        return data_type(self.description["precision"])

    def _compiled(self, asked: str, functions_of: Callable[..., Any], other: type) -> Any:
        """Jitted functions of the energies; `InputError` if the energies are of the other kind."""
        if isinstance(self.energies, other):
            raise self._refusal(asked)
        needs = self.description.get("needs")
        d = None if needs is None else len(needs["joints"])
        return compiled(functions_of(self.energies, degrees_of_freedom=d), self.dtype)

    def _of(self, asked: str, kind: type) -> Any:
        if not isinstance(self.model, kind):
            raise self._refusal(asked)
        return self.model

    def _refusal(self, asked: str) -> InputError:
        if isinstance(self.model, FunctionModel):
            offered = ".derivatives"
        elif isinstance(self.model, ImageModel):
            offered = ".images"
        elif not isinstance(self.model, Model):
            offered = ".value"
        else:
            plain = {PhaseRates: ".flow", InverseForward: ".dynamics"}
            offered = plain.get(type(self.energies), ".dynamics or .flow")
        return InputError(f"a {self.description['name']} has no {asked}; use {offered}")


def save_model(
    directory: str | Path, description: Description, parameters: Parameters, *, overwrite: bool = False
) -> None:
    """Writes `model.safetensors` and `model.json` into an existing folder, for `load`; public as `dln_jax.save`.

    Args:
        directory: the folder.
        description: from `describe`.
        parameters: parameters of that model.
        overwrite: replace the model in the folder and discard its uncertainty.

    Raises:
        InputError: the folder does not exist or already has a model, or the parameters belong to another model.

    Example:
        >>> import tempfile
        >>> import jax
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("revolute",))
        >>> description = dln_jax.describe("structured-delan", precision="f32", needs=needs, width=8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dln_jax.save(folder, description, dln_jax.build(description).init(jax.random.key(0)))
        ...     run = dln_jax.load(folder)
        >>> print(run.description["width"], run.dynamics.inverse_dynamics([0.3], [0.5], [2.0]).shape)
        8 (1,)
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder; create it first")
    if is_file(directory / f"{MODEL}.json") and not overwrite:
        raise InputError(f"{directory} already contains a model; choose another folder, or pass overwrite=True")
    save(directory, description, parameters)


def save(directory: str | Path, description: Description, parameters: Parameters) -> None:
    """Like `save_model`, but replaces the model of a running training; `InputError` for parameters of another model."""
    name = description.get("name")
    if name == OWN or ":" in str(name):
        like = jax.tree.map(np.asarray, parameters)  # a user's factory: only the structure is known
    else:
        like = jax.eval_shape(build(description).init, jax.random.key(0))
    require_fitting(parameters, like)
    for ending in ("json", "safetensors"):  # the uncertainty of an earlier model
        with suppress(OSError):
            (Path(directory) / f"{UNCERTAINTY}.{ending}").unlink(missing_ok=True)
    save_tree(Path(directory), MODEL, parameters, {"model": description})


def load(directory: str | Path, *, factory: Callable[..., Any] | None = None, trust: bool = False) -> Run:
    """Loads a trained model from its run folder.

    Args:
        directory: folder written by a training command, by `Fit.save` or by `save`.
        factory: factory of a model outside the catalogue.
        trust: import the factory that the file names. Use it only for your own files: importing runs code.

    Returns:
        The model with jitted functions of one state (`dynamics`, `flow`, ...), its parameters and its uncertainty.

    Raises:
        InputError: the folder has no model, or the model is damaged, altered or from another schema; a factory outside
            the catalogue is neither passed nor trusted; or the model needs double precision (the message has the line
            to add).

    Example:
        >>> import tempfile
        >>> import jax
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("revolute",))
        >>> description = dln_jax.describe("trigonometric", precision="f32", needs=needs, degree=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dln_jax.save(folder, description, dln_jax.build(description).init(jax.random.key(0)))
        ...     print(repr(dln_jax.load(folder)).splitlines()[0])
        Run of trigonometric: 5 parameters, f32
    """
    directory = Path(directory)
    description = load_manifest(directory, MODEL).get("model")
    if not isinstance(description, dict):
        raise InputError(f"{directory / MODEL}.json: describes no model; {REMEDY}")
    if description.get("precision") == "f64":
        require_double_precision(str(directory))
    try:
        model = build(description, factory=factory, trust=trust)
    except InputError as error:
        raise InputError(f"{directory / MODEL}.json: {error}") from None
    like = jax.eval_shape(model.init, jax.random.key(0))
    parameters = load_tree(directory, MODEL, like)
    parameters = jax.tree.map(lambda leaf, as_built: leaf.astype(as_built.dtype), parameters, like)
    return Run(model, parameters, description, load_uncertainty(directory), _value_in(directory, model, parameters))


def _value_in(directory: Path, model: Any, parameters: Parameters) -> "ValueRun | None":
    """Returns the value function in a model's folder, if there is one."""
    if not is_file(directory / f"{VALUE}.json"):
        return None
    from dln_jax.zoo.value_functions import load_value  # other runs do not need optimal control

    return load_value(directory, model, parameters)


def compiled(functions: Functions, dtype: Any) -> Functions:
    """Jits the functions, and converts numbers in their arguments to this dtype."""
    return jax.tree.map(lambda function: _jitted(function, dtype), functions)


def _jitted(function: Callable[..., Any], dtype: Any) -> Any:
    def convert(leaf):
        # The function itself refuses other types.
        kinds = (jnp.floating, jnp.integer)
        return leaf.astype(dtype) if any(jnp.issubdtype(leaf.dtype, kind) for kind in kinds) else leaf

    @jax.jit
    @functools.wraps(function)
    def call(*state, **named):
        state, named = jax.tree.map(convert, (state, named))
        return function(*state, **named)

    return call
