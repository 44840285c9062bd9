"""Joint friction for any model, with the laws named in the needs.

All models share this parametrisation. Models trained by gradient descent have parameters x with

    coefficients = softplus(x) > 0, offsets = x, sigmoid's shift = x, share of load = 1 / (1 + exp(-x)) in (0, 1)
    Stribeck's velocity and the sigmoid's slope = default exp(x) > 0

The velocity scale is fixed, since only the user knows the step of the integrator. In models that are linear in their
parameters, the coefficients themselves are parameters of one least-squares problem. A negative coefficient then shows
that the data do not identify the law. Shapes keep their defaults there (`learning.friction` fits them), and load
friction is refused, because it multiplies the forces of the energies.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.friction import (
    FrictionCoefficients,
    FrictionShape,
    coefficients_of,
    joint_dissipation,
    require_laws,
    require_shape,
    shape_of,
)
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError, Needs

START = -3.0
"""Initial x of positive coefficients: softplus gives 0.05 N m or N m s, as for the viscous friction of networks."""
HELD = "velocity_scale"


class FrictionParameters(NamedTuple):
    """Parameters of the friction laws in use, by name; linear coefficients are separate from the shapes."""

    coefficients: dict[str, Any]
    """Arrays [d] named as in `FrictionCoefficients`, before the parametrisation above."""
    shape: dict[str, Any]
    """Arrays [d] named as in `FrictionShape`, and "load"; empty for linear models."""


def with_joint_friction(
    model: Model,
    needs: Needs,
    *,
    linear: bool = False,
    shape: FrictionShape | None = None,
    dtype: DTypeLike = jnp.float32,
) -> Model:
    """Returns the model with joint friction, with parameters {"model": its own, "friction": `FrictionParameters`}.

    Args:
        model: model of coordinates, of a phase space, or without an energy; built for needs without joint friction.
        needs: `joint_friction` names the laws, `joint_map` maps coordinates to joints, and `velocity_scale` smooths dry
            friction. Without laws the model is returned unchanged.
        linear: keeps a model linear in its parameters.
        shape: initial values of learned shapes and values of fixed shapes; by default the velocity scale of the needs.
        dtype: type of the friction parameters.

    Raises:
        InputError: an unknown law, two laws for one friction, load in a linear model, or a shape that is not positive.
    """
    laws = needs.joint_friction
    require_laws(laws, "joint_friction")
    if not laws:
        return model
    if linear and "load" in laws:
        raise InputError(
            "load friction multiplies the forces of the energies, so the model is not linear in its parameters; "
            "leave load out, or train a network"
        )
    start = FrictionShape(velocity_scale=needs.velocity_scale) if shape is None else shape
    require_shape(start)
    d = needs.degrees_of_freedom
    learned = [name for name in shape_of(laws) if name != HELD and not linear] + ["load"] * ("load" in laws)
    starts = {"sigmoid_shift": start.sigmoid_shift, "load": START}

    def init(key: Array) -> Parameters:
        friction = FrictionParameters(
            {name: jnp.full(d, 0.0 if linear or name == "offset" else START, dtype) for name in coefficients_of(laws)},
            {name: jnp.full(d, starts.get(name, 0.0), dtype) for name in learned},
        )
        return {"model": model.init(key), "friction": friction}

    def energies(parameters: Parameters) -> Any:
        friction = parameters["friction"]
        coefficients, fitted = friction_of(friction, start, linear=linear)
        dissipation = joint_dissipation(**coefficients._asdict(), **fitted._asdict(), joint_map=needs.joint_map)
        load = None
        if "load" in friction.shape:
            load = Load(jax.nn.sigmoid(friction.shape["load"]), fitted.velocity_scale, needs.joint_map)
        return with_friction(model.energies(parameters["model"]), dissipation, load)

    return Model(init, energies)


def friction_of(
    parameters: FrictionParameters, start: FrictionShape, *, linear: bool = False
) -> tuple[FrictionCoefficients, FrictionShape]:
    """Returns coefficients and shapes from the parameters; arguments as for `with_joint_friction`."""
    coefficients = {
        name: x if linear or name == "offset" else jax.nn.softplus(x) for name, x in parameters.coefficients.items()
    }
    shape = {
        name: x if name == "sigmoid_shift" else jnp.asarray(getattr(start, name), x.dtype) * jnp.exp(x)
        for name, x in parameters.shape.items()
        if name != "load"
    }
    return FrictionCoefficients(**coefficients), start._replace(**shape)
