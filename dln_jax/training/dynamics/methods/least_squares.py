"""Fits models that are linear in their parameters: one least-squares problem for each choice of degrees."""

import time
from pathlib import Path
from typing import Any

from jax.sharding import Mesh

from dln_jax.learning.engine.problem import Training
from dln_jax.learning.linear import choose_degrees, fit_linear
from dln_jax.learning.objectives import Objective
from dln_jax.training.dynamics.methods.direct import refined_if_asked, training_of, with_needed_offset
from dln_jax.training.dynamics.options import TrigonometricOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Task
from dln_jax.zoo.descriptions import build, describe_for


def plan(
    options: TrigonometricOptions, kind: str, recorded: Recorded, objective: Objective
) -> tuple[dict[str, Any], None]:
    """Plans the model with the stated degree, or with degree 1 until validation chooses others."""
    degree = 1 if options.degree is None else options.degree
    precision = options.precision or "f64"
    return describe_for(kind, recorded.sets.train, recorded.needs, precision=precision, degree=degree), None


def fit(task: Task, options: TrigonometricOptions, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Fits the model by least squares; without a stated degree, validation chooses the degrees first."""
    began = time.perf_counter()
    chosen = None
    if options.degree is None:
        chosen, trials = choose_degrees(task.needs, task.sets.train, task.sets.validation)
        tried = ", ".join(f"{_degrees(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
        print(f"validation error by degrees of the joints: {tried}; chosen {_degrees(chosen.candidate)}")
        task = task._replace(description={**task.description, "degree": list(chosen.candidate)})
    fitted = chosen.outcome if chosen is not None else fit_linear(build(task.description), task.sets.train)
    task, fitted = with_needed_offset(task, fitted, lambda lean: fit_linear(build(lean.description), lean.sets.train))
    size = f"{fitted.parameter_count} parameters, rank {fitted.rank}, condition {fitted.condition:.3g}"
    print(f"least squares: {size}")
    training = training_of(task, fitted.parameters, fitted.torque_mse, time.perf_counter() - began)
    return task, refined_if_asked(task, training)


def _degrees(degrees: tuple[int, ...]) -> str:
    return "-".join(map(str, degrees))


METHOD = Method(plan, fit)
