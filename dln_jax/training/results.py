"""Output common to all kinds of runs: tables with units, and costs."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from dln_jax.learning.engine.optimisers import Optimiser, name_of
from dln_jax.learning.engine.problem import Progress, Training
from dln_jax.learning.latency import Latency

OF_LOSSES = {"error": "loss", "loss": "training loss"}
"""Labels of a curve that shows losses."""


def losses(at: Progress) -> str:
    """Losses for a line of progress; medians over seeds."""
    return f"loss {np.median(at.loss):.2e}  validation {np.median(at.validation):.2e}"


def settings_of(optimiser: Optimiser) -> dict[str, Any]:
    """Settings of the optimiser for the file of arguments."""
    return {"optimizer": name_of(optimiser), **optimiser._asdict()}


def unit_of(metric: str, units: Mapping[str, str]) -> str:
    """Unit of a metric: from `units`, or of a time by its suffix; empty otherwise."""
    return units.get(metric, "s" if metric.endswith("_seconds") else "µs" if metric.endswith("_us") else "")


def number(metric: str, value: int | float) -> str:
    """Formats a metric for a table."""
    if isinstance(value, int):
        return f"{value:,}"
    if any(word in metric for word in ("_mse", "_nmse", "_loss", "spread", "error", "eigenvalue", "condition")):
        return f"{value:.2e}"
    return f"{value:,.2f}" if "share" in metric or metric.startswith("vpt") else f"{value:,.1f}"


def one_step_metrics(latency: Latency) -> dict[str, float]:
    """Latency metrics of single calls."""
    return {"one_step_p50_us": latency.p50_us, "one_step_p99_us": latency.p99_us}


def cost_metrics(training: Training, latency: Latency, *, parameters: int, best_step: int) -> dict[str, float | int]:
    """Costs of training a model and of its calls."""
    seconds = {"compile_seconds": training.compile_seconds, "train_seconds": training.train_seconds}
    steps = {"parameters": parameters, "steps": training.stop.step, "best_step": best_step}
    return {**steps, **seconds, **one_step_metrics(latency)}
