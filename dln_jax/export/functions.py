"""Functions to export from a run or a system: pure functions of one state, with example arguments.

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
without meaning for a system are missing.
"""

import functools
import inspect
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.export.c.interface import Function
from dln_jax.mechanics import discrete, jacobians
from dln_jax.mechanics.discrete import ITERATIONS, Actuation
from dln_jax.mechanics.dynamics import Dynamics, Flow, PhaseRates
from dln_jax.mechanics.equations import Canonical, System, dynamics, flow
from dln_jax.mechanics.jacobians import Natural
from dln_jax.models.baselines import FunctionModel
from dln_jax.models.latent_phase import ImageModel
from dln_jax.precision import data_type
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import Run

Functions = dict[str, tuple[Function, tuple[np.ndarray, ...]]]
"""name -> (function, one example per argument, with its shape and dtype)."""
Named = dict[str, Function]
"""Functions of arrays that return arrays by name."""
LARGEST_FACTOR = 250_000
"""Largest number of entries of an exported covariance factor; an entry takes about 24 bytes of C."""


def functions_of_run(
    run: Run,
    *,
    precision: str | None = None,
    names: Iterable[str] | None = None,
    iterations: int = ITERATIONS,
    temperature: float | None = None,
) -> Functions:
    """Returns the functions of a trained model, such as `load(folder)`.

    Args:
        precision: f32 or f64; parameters are converted to it. Default: the precision of the training.
        names: names of the functions to return; default: all.
        iterations: as for `functions_of_system`.
        temperature: temperature in °C for a robot with temperature-dependent friction; default: the reference
            temperature of its identification.

    Raises:
        InputError: the model has no such function or does not depend on temperature, a parameter is beyond the range of
            the precision, or a user-defined model has no needs or another training precision.
    """
    description = run.description
    changes = {}
    if temperature is not None:
        if not np.any(description.get("cooling", 0.0)):
            raise InputError("the model does not depend on temperature; leave --temperature out")
        changes["temperature"] = float(temperature)
    if precision not in (None, description["precision"]):
        if description["name"] not in CATALOGUE:
            raise InputError(f"export a user-defined model in its training precision, {description['precision']}")
        changes["precision"] = precision
    description = {**description, **changes}
    model = build(description) if changes else run.model
    dtype = data_type(description["precision"])

    parameters = jax.tree.map(lambda leaf: leaf.astype(dtype), run.parameters)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(parameters)):
        raise InputError(f"a parameter is beyond the range of {dtype.__name__}; train again, or export in f64")
    run = replace(run, model=model, description=description, parameters=parameters)
    if isinstance(model, FunctionModel):
        derivatives = model.derivatives(parameters)
        networks = {
            "value": _named(derivatives, "y"),
            "value_and_jacobian": _named(derivatives, "y", "jacobian"),
            "value_jacobian_hessian": _named(derivatives, "y", "jacobian", "hessian"),
        }
        functions = _with_examples(networks, dtype, description["sizes"][0])
    elif isinstance(model, ImageModel):
        images = model.images(parameters)
        networks = {"encode": _named(images.encode, "q", "p"), "decode": _named(images.decode, "frames")}
        networks |= _of_flow(images.field, iterations)
        functions = _with_examples(networks, dtype, 1, frames=(2 * description["pixels"],))
    elif (needs := description.get("needs")) is None:
        raise InputError("the model has no needs; export functions_of_system of its energies")
    else:
        d = len(needs["joints"])
        functions = functions_of_system(
            run.energies, d, dtype=dtype, actuation=needs["actuation"], iterations=iterations
        )
        if run.uncertainty is not None and run.uncertainty.factor.size <= LARGEST_FACTOR:
            uncertain = {
                "torque_std": _named(run.torque_std, "tau_std"),
                "out_of_distribution": _named(run.out_of_distribution, "out_of_distribution"),
            }
            functions |= _with_examples(uncertain, dtype, d)
    chosen = functions if names is None else list(names)
    if unknown := [name for name in chosen if name not in functions]:
        raise InputError(
            f"a {description['name']} has no {', '.join(unknown)[:200]}; choose from {', '.join(functions)}"
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
        system: a record of energies or closed-form dynamics, such as `closed_form` of a scene.
        actuation: matrix [d, u] with tau = actuation u, for the steps; default: u is tau.
        iterations: Newton steps of the implicit midpoint rule, as for `mechanics.discrete.implicit_midpoint`.
    """
    d = degrees_of_freedom
    rest = jnp.zeros_like
    controls = d if actuation is None else np.shape(actuation)[1]
    # Tracing networks takes long. Jitted, they are traced once instead of once per function.
    traced = jax.tree.map(lambda leaf: jax.jit(leaf) if callable(leaf) else leaf, system)
    link = getattr(traced, "link", traced)
    functions: Named = {}
    if not isinstance(traced, PhaseRates):
        motion = dynamics(traced, degrees_of_freedom=d)
        natural = isinstance(link, Natural)
        forward, with_jacobians = jacobians.differentiable_forward_dynamics(traced, degrees_of_freedom=d)
        of_inverse = partial(jacobians.inverse_dynamics_jacobians, traced)
        of_coriolis = partial(jacobians.coriolis_jacobians, traced)

        def coriolis(q, qd):
            return motion.decompose(q, qd, rest(q)).coriolis

        functions |= _with_derivatives("inverse_dynamics", motion.inverse_dynamics, "tau", slopes=of_inverse)
        functions |= _with_derivatives("forward_dynamics", forward, "qdd", slopes=lambda *x: with_jacobians(*x)[1])
        functions |= _with_derivatives("coriolis", coriolis, "c", slopes=of_coriolis)
        if not natural or link.potential is not None:
            functions |= _with_derivatives("gravity", lambda q: motion.decompose(q, rest(q), rest(q)).gravity, "g")
        if isinstance(motion, Dynamics):
            mass_matrix = (lambda q: motion.mass_matrix(q)) if natural else motion.mass_matrix
            functions |= _with_derivatives("energy", motion.energy, "energy")
            functions |= _with_derivatives("mass_matrix", mass_matrix, "M")
            if getattr(traced, "dissipation", None) is not None:
                functions |= _with_derivatives("friction", motion.friction, "tau_friction")
        functions |= _steps(
            ("x_next",),
            ("A", "B"),
            step_rk4=discrete.rk4(forward, actuation=actuation),
            step_implicit_midpoint=discrete.implicit_midpoint(forward, actuation=actuation, iterations=iterations),
        )
    if isinstance(link, Canonical | PhaseRates):
        functions |= _of_flow(flow(traced, degrees_of_freedom=d), iterations)
    return _with_examples(functions, dtype, d, x=(2 * d,), u=(controls,))


def _with_examples(functions: Named, dtype: DTypeLike, size: int, **shapes: tuple[int, ...]) -> Functions:
    """Pairs functions with example vectors of this size, except for arguments with other shapes."""
    shapes["dt"] = ()
    return {
        name: (
            function,
            tuple(np.zeros(shapes.get(key, (size,)), dtype) for key in inspect.signature(function).parameters),
        )
        for name, function in functions.items()
    }


def _of_flow(system: Flow | PhaseRates, iterations: int) -> Named:
    functions = _with_derivatives("rates", system.rates, "qd", "pd")
    if isinstance(system, Flow):
        functions |= _with_derivatives("hamiltonian", system.energy, "H")
    return functions | _steps(
        ("q_next", "p_next"),
        ("q_next_q", "q_next_p", "p_next_q", "p_next_p"),
        phase_step_rk4=discrete.phase_rk4(system.rates),
        phase_step_implicit_midpoint=discrete.phase_implicit_midpoint(system.rates, iterations=iterations),
    )


def _steps(results: Sequence[str], slopes: Sequence[str], **steps: Function) -> Named:
    functions: Named = {}
    for name, step in steps.items():
        functions[name] = _named(step, *results)
        functions[f"{name}_jacobian"] = _named(discrete.linearised(step), *results, *slopes)
    return functions


def _named(function: Function, *results: str, like: Function | None = None) -> Function:
    """Returns the function with named first results, and with the parameters of another function."""

    @functools.wraps(like or function)
    def call(*state):
        # JAX sorts the keys of a plain dictionary, but keeps the order of this one.
        return OrderedDict(zip(results, jax.tree.leaves(function(*state)), strict=False))

    return call


def _with_derivatives(name: str, function: Function, *results: str, slopes: Function | None = None) -> Named:
    """Returns the function, and the derivatives of its results by its arguments, from `slopes` if present."""

    def derivatives(*state):
        rows = sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(function, *state)))
        places = tuple(range(len(state)))
        if rows < sum(array.size for array in state):
            return jax.jacrev(function, argnums=places)(*state)
        # One argument at a time, because results that do not depend on it need no derivatives.
        columns = [jax.tree.leaves(jax.jacfwd(function, argnums=place)(*state)) for place in places]
        return list(zip(*columns, strict=True))

    ending = "gradient" if name in ("energy", "hamiltonian") else "jacobian"
    names = [f"{result}_{argument}" for result in results for argument in inspect.signature(function).parameters]
    return {
        name: _named(function, *results),
        f"{name}_{ending}": _named(slopes or derivatives, *names, like=function),
    }
