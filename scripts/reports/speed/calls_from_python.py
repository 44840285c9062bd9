"""Times of calls from Python, of exported C and of Pinocchio, a rival in dynamics of rigid bodies."""

import importlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from dln_jax.metrics.latency import medians_in_turns

STATES = 256


class Timed(NamedTuple):
    """A function of a state of three vectors [d]."""

    function: Callable[..., Any]
    d: int
    dtype: DTypeLike
    title: str = ""
    """Name and release of a rival."""


def seconds_of_calls(functions: Mapping[str, Timed], *, repetitions: int) -> dict[str, float]:
    """Times of calls with arrays in and out, s; loops over random states take turns, and medians count."""
    random, loops = np.random.default_rng(0), {}
    for name, (function, d, dtype, _) in functions.items():
        states = random.normal(size=(STATES, 3, d)).astype(dtype)
        loops[name] = partial(call_all, function, [tuple(state) for state in states])
    return {name: each / STATES for name, each in medians_in_turns(loops, (), repetitions=repetitions).items()}


def call_all(function: Callable[..., Any], states: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Calls a function with all states."""
    for state in states:
        function(*state)


def pinocchio_functions(d: int) -> dict[str, Timed]:
    """Pinocchio's inverse and forward dynamics, rnea and aba, of an arm of d revolute joints.

    Prints a line and returns none if the package is missing. Joints turn about axes of their frames, which Pinocchio
    handles faster than general axes.
    """
    try:
        pin: Any = importlib.import_module("pinocchio")
    except ImportError:
        print("Pinocchio is missing, and so are its rows; pip install 'dln-jax[reference]'")
        return {}
    model, random = pin.Model(), np.random.default_rng(2)
    axes = (pin.JointModelRZ, pin.JointModelRY, pin.JointModelRX)
    for joint in range(d):
        place = pin.SE3(np.eye(3), 0.3 * random.normal(size=3))
        added = model.addJoint(joint, axes[joint % 3](), place, f"joint_{joint}")
        moments = np.diag(random.uniform(1.0, 1.5, size=3))
        inertia = pin.Inertia(random.uniform(1.0, 3.0), 0.1 * random.normal(size=3), moments)
        model.appendBodyToJoint(added, inertia, pin.SE3.Identity())
    data = model.createData()
    return {
        name: Timed(partial(getattr(pin, name), model, data), d, np.float64, f"{name} of Pinocchio {pin.__version__}")
        for name in ("rnea", "aba")
    }
