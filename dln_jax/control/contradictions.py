"""Finds trajectory problems that contradict themselves, before anything is solved."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

from dln_jax.control.trajectories import TrajectoryProblem, knots_of
from dln_jax.types import InputError

ROUNDING = 1e-9
"""Smaller differences, relative or absolute, count as zero."""


def require_start(problem: TrajectoryProblem, x: Any) -> None:
    """Raises `InputError` if a known start is outside its limits, because no control changes it."""
    known = [x, problem.lower_x, problem.upper_x]
    if any(isinstance(value, Tracer) for value in known) or not np.isfinite(x).all():
        return
    x = np.asarray(x, float)
    fixed = np.ones(len(x), bool) if problem.free is None else ~np.asarray(problem.free)
    for word, limit, sign in (("below its lower", problem.lower_x, -1), ("above its upper", problem.upper_x, 1)):
        limit = np.broadcast_to(np.asarray(limit, float), x.shape)
        for i in np.flatnonzero(fixed & (sign * (x - limit) > 0))[:1]:
            raise InputError(f"state {i} starts at {x[i]:.6g}, {word} limit of {limit[i]:.6g}; start inside the limits")
    if problem.states is not None and fixed.all():
        first = jax.tree.map(lambda rows: rows[0], knots_of(problem)[0])
        excesses = _known(problem.states, x, *first)
        for i, excess in enumerate([] if excesses is None else excesses):
            if excess > 0:
                raise InputError(f"constraint {i} on the states is {excess:.6g} at the start; expected zero or less")


def require_end(problem: TrajectoryProblem, states: int) -> None:
    """Raises `InputError` if no state within the limits meets a hard linear constraint of the end."""
    if any(isinstance(limit, Tracer) for limit in (problem.lower_x, problem.upper_x)):
        return
    limits = [np.broadcast_to(np.asarray(limit, float), states) for limit in (problem.lower_x, problem.upper_x)]
    if not np.isfinite(limits).any():
        return
    below = problem.end_below if problem.soft is None else None
    for name, rows, signs in (("equation", problem.end, (1, -1)), ("inequality", below, (1,))):
        for sign in signs if rows is not None else ():
            for i, least in enumerate(_least(problem, rows, sign, *limits)):
                if least > ROUNDING:
                    raise InputError(
                        f"{name} {i} of the end misses zero by {least:.6g} or more within the limits of the states; "
                        "widen the limits, or move the end"
                    )


def _least(problem: TrajectoryProblem, rows: Any, sign: int, low: np.ndarray, high: np.ndarray) -> list[float]:
    """Returns the least value of each row times a sign within limits; -inf if it is unbounded, nonlinear or unknown."""
    _, last = knots_of(problem)

    def values(x: Array) -> Array:
        return sign * rows(x, *last)

    a, b = np.clip(np.random.default_rng(0).normal(size=(2, len(low))), low, high)
    known = _known(lambda a, b: (values(a), values(b), jax.jacfwd(values)(a)), a, b)
    least = []
    for i, (at, other, slope) in enumerate(zip(*known, strict=True) if known else ()):
        corner = np.where(slope > 0, low, np.where(slope < 0, high, a))
        reached = _known(values, corner) if np.isfinite(corner).all() else None
        linear = reached is not None and np.allclose(
            [other, reached[i]], at + (np.stack([b, corner]) - a) @ slope, rtol=ROUNDING, atol=ROUNDING
        )
        least.append(float(reached[i]) if reached is not None and linear else -np.inf)
    return least


def _known(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns the value of a function, or `None` if it depends on traced values."""
    with jax.ensure_compile_time_eval():
        value = jax.jit(function)(*arguments)
    return None if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value)) else jax.tree.map(np.asarray, value)
