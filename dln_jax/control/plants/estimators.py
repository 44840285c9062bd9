"""Turns controllers of states into controllers of measurements, for the plants of a layout."""

from collections.abc import Callable

import numpy as np

from dln_jax.control.closed_loop import Controller
from dln_jax.control.estimate.kalman import Process, belief
from dln_jax.control.observers import with_differences, with_estimate
from dln_jax.control.plants.plant import Layout
from dln_jax.control.state_space import Law
from dln_jax.types import InputError

Estimator = Callable[[Law | Controller], Controller]
"""Law or controller of (q, qd) -> controller of measurements of q."""
FASTEST_FILTER = 50.0
"""Largest cut-off frequency for differences, Hz; it is also at most a quarter of the sampling rate."""
ESTIMATORS = "extended", "unscented", "differences"
"""Names of `estimator_of`."""
UNSURE = 1.0
"""Standard deviation of the first estimate: of coordinates in rad or m, and of rates in 1/s or m/s."""


def require_estimator(name: str) -> None:
    """Raises `InputError` for a name that is not one of `ESTIMATORS`."""
    if name not in ESTIMATORS:
        raise InputError(f"estimator is {name!r:.40}; choose from {', '.join(ESTIMATORS)}")


def by_differences(layout: Layout) -> Estimator:
    """Returns an estimator of the rates by differences of the measurements and a low-pass."""
    cutoff = min(FASTEST_FILTER, layout.rate / 4)
    return lambda law: with_differences(law, len(layout.joints), rate=layout.rate, cutoff=cutoff)


def by_filter(layout: Layout, process: Process, *, delay: int | float = 0) -> Estimator:
    """Returns an estimator of the states by a filter of the measurements, which uses their times.

    Args:
        layout: layout of the plant.
        process: such as that of `estimate.from_log`.
        delay: samples after which a control begins to act.
    """
    lower, upper = layout.limits.control.T
    d, m = layout.actuation.shape
    start = belief(np.concatenate([layout.hanging, np.zeros(d)]), np.full(2 * d, UNSURE))
    return lambda law: with_estimate(
        law, process, start, rate=layout.rate, controls=m, lower=lower, upper=upper, delay=delay
    )


def estimator_of(name: str, layout: Layout, process: Process | None, *, delay: int | float) -> Estimator:
    """Returns the estimator with a name.

    Args:
        name: one of `ESTIMATORS`.
        layout: layout of the plant.
        process: for the filters.
        delay: samples after which a control begins to act.

    Raises:
        InputError: the name is unknown, or a filter has no process.
    """
    require_estimator(name)
    if name == "differences":
        return by_differences(layout)
    if process is None:
        raise InputError(f"the filter {name!r} needs a process, such as that of estimate.from_log")
    return by_filter(layout, process._replace(unscented=name == "unscented"), delay=delay)
