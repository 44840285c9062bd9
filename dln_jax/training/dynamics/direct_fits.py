"""Models fitted without an optimiser: by linear least squares, a kernel, or a search for joint frames."""

import time

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.learning import dynamics
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Progress, Stop, Training, one_after_the_other
from dln_jax.learning.kernel import choose_kernel
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.learning.linear import choose_degrees, fit_linear
from dln_jax.models.model import Parameters
from dln_jax.precision import data_type
from dln_jax.training.dynamics.options import Options
from dln_jax.training.dynamics.task import Task, needs_of_tree
from dln_jax.types import InputError
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build

REFINEMENTS = 50
"""Upper limit of Gauss-Newton steps after a linear fit, which starts near the minimum."""


def fit_directly(task: Task, given: Options) -> tuple[Task, Training]:
    """Fits the task's model directly; returns the task with everything the fit has chosen, and the training.

    Direct fits are to torques; for another objective they are the starting point of Gauss-Newton.
    """
    task, training = _fitted_to_torques(task, given)
    return task, training if task.objective.of_torques else refined(task, training)


def refined(task: Task, start: Training) -> Training:
    """Refines the parameters for the task's objective; the start is kept unless the validation error decreases.

    Raises:
        InputError: the model has too many parameters for Gauss-Newton, or a precision that it does not support.
    """
    model = build(task.description)
    suited, reason = dynamics.suited_optimiser(model, task.sets, task.objective)
    if suited is not GaussNewton or task.precision != "f64":
        why = reason if task.precision == "f64" else "the precision is f32"
        raise InputError(f"--objective refines a {task.kind} model by Gauss-Newton in f64, but {why}; leave it out")
    problem = dynamics.problem(model, task.sets, task.objective)._replace(parameters=start.parameters)
    found = fit(problem, GaussNewton(steps=REFINEMENTS, improvement=1e-6), seconds=task.seconds, must_start=False)
    history = one_after_the_other([start.history, found.history])
    print(f"refined by both sides' errors: validation {start.validation:.2e}, after it {found.validation:.2e}")
    better = np.isfinite(found.validation) and found.validation < start.validation
    return (found if better else start)._replace(history=history, compile_seconds=found.compile_seconds)


def _fitted_to_torques(task: Task, given: Options) -> tuple[Task, Training]:
    properties = CATALOGUE[task.kind].properties
    if properties.searched:
        return fit_learned_tree(task, given)
    if properties.kernel:
        return fit_trigonometric_kernel(task)
    return fit_trigonometric(task, grown=given.degree is None)


def fit_learned_tree(task: Task, given: Options) -> tuple[Task, Training]:
    """Searches joint frames by Gauss-Newton from random starts and eliminates all other parameters."""
    needs, sketch = needs_of_tree(task.needs), task.recorded.sketch
    near = (
        {}
        if sketch is None
        else {"sketch": sketch.frames, "sketch_angle": sketch.angle, "sketch_length": sketch.length}
    )
    fit = fit_tree(
        needs,
        task.sets.train,
        task.sets.validation,
        parents=task.description["parents"],
        acceleration=task.description["acceleration"],
        velocity_scale=task.description["velocity_scale"],
        settings=Search(seed=given.seed, seconds=task.seconds, **near),
        report=print,
    )
    size = f"{fit.parameter_count} parameters, of the linear ones rank {fit.rank}, condition {fit.condition:.3g}"
    print(f"learned tree: {size}")
    return task._replace(search=fit), training_of(task, fit.parameters, fit.torque_mse, fit.seconds)


def fit_trigonometric(task: Task, *, grown: bool) -> tuple[Task, Training]:
    """Fits the trigonometric model by least squares; `grown` lets validation choose the degrees first."""
    began = time.perf_counter()
    chosen = None
    if grown:
        chosen, trials = choose_degrees(task.needs, task.sets.train, task.sets.validation)
        tried = ", ".join(f"{_degrees(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
        print(f"validation error by degrees of the joints: {tried}; chosen {_degrees(chosen.candidate)}")
        task = task._replace(description={**task.description, "degree": list(chosen.candidate)})
    fitted = chosen.outcome if chosen is not None else fit_linear(build(task.description), task.sets.train)
    size = f"{fitted.parameter_count} parameters, rank {fitted.rank}, condition {fitted.condition:.3g}"
    print(f"least squares: {size}")
    return task, training_of(task, fitted.parameters, fitted.torque_mse, time.perf_counter() - began)


def fit_trigonometric_kernel(task: Task) -> tuple[Task, Training]:
    """Fits two kernels, with and without the assumption of a serial chain, and selects one by validation."""
    began = time.perf_counter()
    most, given = task.description["samples"], len(task.sets.train.tau)
    chosen, trials = choose_kernel(task.needs, task.sets.train, task.sets.validation, samples=most)
    fit = chosen.outcome
    if fit.samples < given:
        print(f"kernel: {fit.samples} of {given} samples, evenly spaced; --samples takes more")
    tried = ", ".join(f"{_order(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
    print(f"validation error in units of the torques' variance by order of the bodies: {tried}")
    noise = ", ".join(f"{each:.2g}" for each in fit.noise)
    size = f"{fit.parameter_count} equations, log likelihood {fit.likelihood:.2f} by the torque"
    print(f"kernel: {_order(chosen.candidate)}, {size}, noise of the joints {noise}")
    description = {**task.description, "samples": fit.samples, "serial": chosen.candidate}
    task = task._replace(description=description)
    return task, training_of(task, fit.parameters, fit.torque_mse, time.perf_counter() - began)


def _order(serial: bool) -> str:
    return "a chain" if serial else "any order"


def training_of(task: Task, parameters: Parameters, loss: float, seconds: float) -> Training:
    """Wraps a direct fit as a one-step training history."""
    model, dtype = build(task.description), data_type(task.precision)
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    errors = dynamics.validation_errors(model, task.sets, parameters, task.objective)
    at = Progress(1, loss, float(np.mean(errors)), float("nan"), seconds)
    return Training(parameters, [at], Stop("finished", 1), 1, 0.0)


def _degrees(degrees: tuple[int, ...]) -> str:
    return "-".join(map(str, degrees))
