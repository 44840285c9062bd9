"""Fits the trigonometric energies as a Gaussian process; validation chooses between a serial chain and any order."""

import time
from pathlib import Path
from typing import Any

from jax.sharding import Mesh

from dln_jax.learning.engine.problem import Training
from dln_jax.learning.kernel import choose_kernel, fit_kernel
from dln_jax.learning.objectives import Objective
from dln_jax.runs.arguments import require_positive_if_given, resolved
from dln_jax.training.dynamics.methods.direct import refined_if_asked, training_of, with_needed_offset
from dln_jax.training.dynamics.options import KernelOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Task
from dln_jax.zoo.descriptions import describe_for

SAMPLES = 600
"""Default for the largest number of samples in the kernel."""


def plan(options: KernelOptions, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], None]:
    """Plans a kernel with at most the stated number of samples."""
    require_positive_if_given(options, ["samples"])
    sizes = resolved(options, {"samples": SAMPLES})
    precision = options.precision or "f64"
    return describe_for(kind, recorded.sets.train, recorded.needs, precision=precision, **sizes), None


def fit(task: Task, options: KernelOptions, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Fits two kernels, with and without the assumption of a serial chain, and selects one by validation."""
    began = time.perf_counter()
    upper, available = task.description["samples"], len(task.sets.train.tau)
    chosen, trials = choose_kernel(task.needs, task.sets.train, task.sets.validation, samples=upper)
    sizes = {"samples": chosen.outcome.samples, "serial": chosen.candidate}
    task = task._replace(description={**task.description, **sizes})
    task, solution = with_needed_offset(
        task, chosen.outcome, lambda lean: fit_kernel(lean.needs, lean.sets.train, **sizes)
    )
    if solution.samples < available:
        print(f"kernel: {solution.samples} of {available} samples, evenly spaced; --samples takes more")
    tried = ", ".join(f"{_order(trial.candidate)}: {trial.validation:.2e}" for trial in trials)
    print(f"validation error in units of the torques' variance by order of the bodies: {tried}")
    noise = ", ".join(f"{sd:.2g}" for sd in solution.noise)
    size = f"{solution.parameter_count} equations, log likelihood {solution.likelihood:.2f} by the torque"
    print(f"kernel: {_order(chosen.candidate)}, {size}, noise of the joints {noise}")
    training = training_of(task, solution.parameters, solution.torque_mse, time.perf_counter() - began)
    return task, refined_if_asked(task, training)


def _order(serial: bool) -> str:
    return "a chain" if serial else "any order"


METHOD = Method(plan, fit)
