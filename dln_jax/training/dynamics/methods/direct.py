"""For fits without an optimiser: friction, one-step history, and refinement by Gauss-Newton for other objectives."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.learning import dynamics
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Progress, Stop, Training, one_after_the_other
from dln_jax.learning.gauges import without_offset
from dln_jax.learning.model_selection import Candidate, FittedModel, select_model
from dln_jax.models.model import Parameters
from dln_jax.precision import data_type
from dln_jax.training.dynamics.task import Task
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build

REFINEMENTS = 50
"""Upper bound on the Gauss-Newton steps from a direct fit, which is near the minimum."""


def with_needed_offset(task: Task, fitted: Any, refit: Callable[[Task], Any]) -> tuple[Task, Any]:
    """Keeps the offset of friction beside a potential if validation motions need it; returns the task and its fit.

    Args:
        fitted: fit of the task, with `parameters`.
        refit: fits the task without the offset.
    """
    needs = without_offset(task.needs)
    if needs == task.needs:
        return task, fitted
    description = {**task.description, "needs": needs._asdict()}
    lean = task._replace(recorded=task.recorded._replace(needs=needs), description=description)
    outcomes = [(lean, refit(lean)), (task, fitted)]
    models = [FittedModel(build(tried.description), result.parameters, (tried, result)) for tried, result in outcomes]
    candidates = [Candidate(task.kind, lambda left, model=model: model) for model in models]
    chosen = select_model(candidates, task.sets.train, task.sets.validation).fitted.outcome
    print(f"friction kept by validation: {', '.join(chosen[0].needs.joint_friction) or 'none'}")
    return chosen


def training_of(task: Task, parameters: Parameters, loss: float, seconds: float) -> Training:
    """Wraps a direct fit as a one-step training history."""
    model, dtype = build(task.description), data_type(task.precision)
    parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), parameters)
    errors = dynamics.validation_errors(model, task.sets, parameters, task.objective)
    at = Progress(1, loss, float(np.mean(errors)), float("nan"), seconds)
    return Training(parameters, [at], Stop("finished", 1), 1, 0.0)


def refined_if_asked(task: Task, training: Training) -> Training:
    """Returns the fit unchanged if the objective is that of torques; otherwise refines it by Gauss-Newton."""
    return training if task.objective.of_torques else refined(task, training)


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
    refit = fit(problem, GaussNewton(steps=REFINEMENTS, improvement=1e-6), seconds=task.seconds, must_start=False)
    history = one_after_the_other([start.history, refit.history])
    print(f"refined by both sides' errors: validation {start.validation:.2e}, after it {refit.validation:.2e}")
    better = np.isfinite(refit.validation) and refit.validation < start.validation
    return (refit if better else start)._replace(history=history, compile_seconds=refit.compile_seconds)
