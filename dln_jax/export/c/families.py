"""The functions exported from a run or a system: pure functions of one state, with example arguments.

For a system with forces, in coordinates and velocities, x = (q, qd):

| name | arguments | results |
|---|---|---|
| `inverse_dynamics` | q, qd, qdd | tau |
| `forward_dynamics` | q, qd, tau | qdd |
| `energy` | q, qd | energy |
| `mass_matrix` | q, and qd where M depends on it | M |
| `gravity`, `coriolis`, `friction` | q; q, qd; q, qd | g; c; tau_friction |
| `torque_std`, `out_of_distribution` | q, qd, qdd | tau_std; out_of_distribution |
| `step_rk4`, `step_implicit_midpoint` | x, u, dt | x_next |

For a phase space without forces: `rates` (qd, pd) and `hamiltonian` (H) of q, p; `phase_step_rk4` and
`phase_step_implicit_midpoint` (q_next, p_next) of q, p, dt. For a differential network: `value`, `value_and_jacobian`
and `value_jacobian_hessian` (y, jacobian, hessian) of x. For a model of images: the functions of its latent phase
space, `encode` (q, p) of two images, and `decode` (frames) of q, p.

NAME_jacobian returns the derivatives of all results with respect to all arguments, such as tau_q [d, d], with the
argument's axes last. A step of x returns x_next, A and B. The derivative of a scalar is called NAME_gradient. Functions
that a system lacks are missing.
"""

import functools
import inspect
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from dln_jax.data.joints import needs_from_json
from dln_jax.mechanics import discrete, jacobians
from dln_jax.mechanics.discrete import ITERATIONS, Actuation
from dln_jax.mechanics.dynamics import Dynamics, Flow, PhaseRates
from dln_jax.mechanics.equations import Canonical, Driven, System, dynamics, flow
from dln_jax.mechanics.jacobians import Natural
from dln_jax.mechanics.joint_friction import LoadedSystem
from dln_jax.models.baselines import FunctionModel
from dln_jax.models.latent_phase import ImageModel, LatentPhase
from dln_jax.models.model import Model
from dln_jax.models.uncertainty import Uncertainty, out_of_distribution, predictive
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import Activation, activation
from dln_jax.nn.differential_mlp import Layers
from dln_jax.precision import data_type
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import Run

Function = Callable[..., Mapping[str, Array]]
"""A function of arrays that returns arrays by name."""
Functions = dict[str, tuple[Function, tuple[np.ndarray, ...]]]
"""name -> (function, one example per argument, with its shape and dtype)."""
Named = dict[str, Function]
DERIVATIVES = ("_jacobian", "_gradient", "_hessian")
"""Endings of the names of derivatives."""
LARGEST_FACTOR = 250_000
"""Largest number of entries of a covariance factor that is exported; an entry takes about 24 bytes of C."""
SCALARS = ("energy", "hamiltonian")
"""Functions with a scalar result, whose derivative is a gradient."""


def functions_of_run(
    run: Run, *, precision: str, names: Iterable[str] | None = None, iterations: int = ITERATIONS
) -> Functions:
    """Returns the functions of a trained model.

    Args:
        precision: f32 or f64; the parameters are converted to it.
        names: names of the functions to return; default: all.
        iterations: as for `functions_of_system`.

    Raises:
        InputError: the model lacks a named function, the precision cannot hold a parameter, or a user-defined model has
            no needs or is exported in another precision than it was trained in.
    """
    functions = _of_run(run, precision, iterations)
    chosen = list(functions) if names is None else list(names)
    if unknown := [name for name in chosen if name not in functions]:
        raise InputError(
            f"a {run.description['name']} has no {', '.join(unknown)[:200]}; choose from {', '.join(functions)}"
        )
    return {name: functions[name] for name in chosen}


def functions_of_system(
    system: System,
    degrees_of_freedom: int,
    *,
    dtype: DTypeLike,
    actuation: Actuation = None,
    iterations: int = ITERATIONS,
) -> Functions:
    """Returns the functions of a known or learned system.

    Args:
        system: a record of energies or of closed-form dynamics, such as the `closed_form` of a scene.
        actuation: matrix [d, u] with tau = actuation u, for the steps; default: u is tau.
        iterations: Newton steps of the implicit midpoint rule, as for `mechanics.discrete.implicit_midpoint`.
    """
    d = degrees_of_freedom
    # Networks take long to trace; jitted, they are traced once instead of once per function that contains them.
    traced = _traced_once(system)
    functions: Named = {}
    if not isinstance(system, PhaseRates):
        functions |= _of_dynamics(traced, d, actuation, iterations)
    if isinstance(_link(system), Canonical | PhaseRates):
        functions |= _of_flow(flow(traced, degrees_of_freedom=d), iterations)
    controls = d if actuation is None else np.shape(actuation)[1]
    return _with_examples(functions, dtype, d, x=(2 * d,), u=(controls,))


def _traced_once(system: Any) -> Any:
    """Returns the system with jitted functions."""
    fields = {name: jax.jit(field) for name, field in system._asdict().items() if callable(field)}
    if isinstance(system, LoadedSystem):
        fields["link"] = _traced_once(system.link)
    return system._replace(**fields)


def _link(system: System) -> Any:
    """Returns the system without its transmissions."""
    return system.link if isinstance(system, LoadedSystem) else system


def _of_run(run: Run, precision: str, iterations: int) -> Functions:
    description, model, dtype = run.description, run.model, data_type(precision)
    if precision != description["precision"]:
        if description["name"] not in CATALOGUE:
            raise InputError(f"a user-defined model is exported in {description['precision']}, that of its training")
        model = build({**description, "precision": precision})
    parameters = jax.tree.map(functools.partial(_converted, dtype), run.parameters)
    if isinstance(model, FunctionModel):
        functions = _of_layers(parameters, activation(description["activation"]))
        return _with_examples(functions, dtype, description["sizes"][0])
    if isinstance(model, ImageModel):
        functions = _of_images(model.images(parameters), iterations)
        return _with_examples(functions, dtype, 1, frames=(2 * description["pixels"],))
    if description.get("needs") is None:
        raise InputError("the model states no needs; export functions_of_system of its energies")
    needs = needs_from_json(description["needs"])
    energies, common = model.energies(parameters), {"actuation": needs.actuation, "iterations": iterations}
    functions = functions_of_system(energies, needs.degrees_of_freedom, dtype=dtype, **common)
    if run.uncertainty is not None and run.uncertainty.factor.size <= LARGEST_FACTOR:
        known = _of_uncertainty(model, parameters, run.uncertainty)
        functions |= _with_examples(known, dtype, needs.degrees_of_freedom)
    return functions


def _converted(dtype: Any, leaf: Array) -> Array:
    converted = leaf.astype(dtype)
    if not (finite := jnp.isfinite(converted)).all():
        raise InputError(
            f"a parameter is {leaf[~finite][0]}, which {dtype.__name__} cannot hold; train again, or export in f64"
        )
    return converted


def _with_examples(functions: Named, dtype: DTypeLike, size: int, **shapes: tuple[int, ...]) -> Functions:
    """Pairs functions with example vectors of this size, except for arguments with other shapes."""
    shapes["dt"] = ()

    def examples(function: Function) -> tuple[np.ndarray, ...]:
        return tuple(np.zeros(shapes.get(key, (size,)), dtype) for key in inspect.signature(function).parameters)

    return {name: (function, examples(function)) for name, function in functions.items()}


def _of_dynamics(system: Driven, d: int, actuation: Actuation, iterations: int) -> Named:
    motion = dynamics(system, degrees_of_freedom=d)
    forward, with_jacobians = jacobians.differentiable_forward_dynamics(system, degrees_of_freedom=d)
    inverse_jacobians = functools.partial(jacobians.inverse_dynamics_jacobians, system)
    coriolis_jacobians = functools.partial(jacobians.coriolis_jacobians, system)
    link = _link(system)
    natural = isinstance(link, Natural)

    def at_rest(q: Array) -> Array:
        return motion.decompose(q, jnp.zeros_like(q), jnp.zeros_like(q)).gravity

    def coriolis(q: Array, qd: Array) -> Array:
        return motion.decompose(q, qd, jnp.zeros_like(q)).coriolis

    def forward_jacobians(q: Array, qd: Array, tau: Array) -> tuple[Array, ...]:
        return with_jacobians(q, qd, tau)[1]

    functions = {
        "inverse_dynamics": _named(motion.inverse_dynamics, "tau"),
        "inverse_dynamics_jacobian": _named(inverse_jacobians, "tau_q", "tau_qd", "tau_qdd"),
        "forward_dynamics": _named(forward, "qdd"),
        "forward_dynamics_jacobian": _named(forward_jacobians, "qdd_q", "qdd_qd", "qdd_tau"),
        "coriolis": _named(coriolis, "c"),
        "coriolis_jacobian": _named(coriolis_jacobians, "c_q", "c_qd"),
    }
    if not natural or link.potential is not None:
        functions |= _with_derivatives("gravity", _named(at_rest, "g"))
    if isinstance(motion, Dynamics):
        mass_matrix = (lambda q: motion.mass_matrix(q)) if natural else (lambda q, qd: motion.mass_matrix(q, qd))
        functions |= _with_derivatives("energy", _named(motion.energy, "energy"))
        functions |= _with_derivatives("mass_matrix", _named(mass_matrix, "M"))
        if getattr(system, "dissipation", None) is not None:
            functions |= _with_derivatives("friction", _named(motion.friction, "tau_friction"))
    rk4 = discrete.rk4(forward, actuation=actuation)
    implicit = discrete.implicit_midpoint(forward, actuation=actuation, iterations=iterations)
    return functions | _steps("step", rk4, implicit, ("x_next",), ("A", "B"))


def _of_uncertainty(model: Model, parameters: Any, known: Uncertainty) -> Named:
    std = predictive(model, parameters, known.factor, known.noise, known.inflation)
    flag = out_of_distribution(model, parameters, known)
    return {"torque_std": _named(std, "tau_std"), "out_of_distribution": _named(flag, "out_of_distribution")}


def _of_flow(system: Flow | PhaseRates, iterations: int) -> Named:
    functions = _with_derivatives("rates", _named(system.rates, "qd", "pd"))
    if isinstance(system, Flow):
        functions |= _with_derivatives("hamiltonian", _named(system.energy, "H"))
    implicit = discrete.phase_implicit_midpoint(system.rates, iterations=iterations)
    slopes = ("q_next_q", "q_next_p", "p_next_q", "p_next_p")
    return functions | _steps("phase_step", discrete.phase_rk4(system.rates), implicit, ("q_next", "p_next"), slopes)


def _of_images(system: LatentPhase, iterations: int) -> Named:
    networks = {"encode": _named(system.encode, "q", "p"), "decode": _named(system.decode, "frames")}
    return networks | _of_flow(system.field, iterations)


def _of_layers(layers: Layers, activation: Activation) -> Named:
    members = [[(weight[k], bias[k]) for weight, bias in layers] for k in range(len(layers[0][1]))]

    def mean(derivatives: Callable[..., Any]) -> Function:
        def function(x: Array) -> Any:
            every = [derivatives(tuple(member), x, activation=activation) for member in members]
            return jax.tree.map(lambda *results: sum(results) / len(members), *every)

        return function

    return {
        "value": _named(mean(differential_mlp.value), "y"),
        "value_and_jacobian": _named(mean(differential_mlp.value_and_jacobian), "y", "jacobian"),
        "value_jacobian_hessian": _named(mean(differential_mlp.value_jacobian_and_hessian), "y", "jacobian", "hessian"),
    }


def _named(function: Callable[..., Any], *results: str) -> Function:
    """Returns the function with named results and unchanged parameters."""

    @functools.wraps(function)
    def call(*state: Array) -> dict[str, Array]:
        # JAX sorts the keys of a plain dictionary, and keeps the order of this one.
        return OrderedDict(zip(results, jax.tree.leaves(function(*state)), strict=True))

    return call


def _steps(
    prefix: str, rk4: Callable[..., Any], implicit: Callable[..., Any], results: Sequence[str], slopes: Sequence[str]
) -> Named:
    functions: Named = {}
    for name, step in ((f"{prefix}_rk4", rk4), (f"{prefix}_implicit_midpoint", implicit)):
        functions[name] = _named(step, *results)
        functions[f"{name}_jacobian"] = _named(discrete.linearised(step), *results, *slopes)
    return functions


def _with_derivatives(name: str, function: Function) -> Named:
    """Returns the function, and one that returns the derivatives of its results with respect to its arguments."""
    arguments = list(inspect.signature(function).parameters)
    places = range(len(arguments))

    @functools.wraps(function)
    def derivatives(*state: Array) -> Mapping[str, Array]:
        rows = sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(function, *state)))
        if rows < sum(array.size for array in state):
            slopes = jax.jacrev(function, argnums=tuple(places))(*state)
        else:
            # One argument at a time: results that do not depend on it need no derivatives.
            columns = [jax.jacfwd(function, argnums=place)(*state) for place in places]
            slopes = {result: [slope[result] for slope in columns] for result in columns[0]}
        return OrderedDict((f"{result}_{arguments[k]}", by[k]) for result, by in slopes.items() for k in places)

    return {name: function, f"{name}_{'gradient' if name in SCALARS else 'jacobian'}": derivatives}
