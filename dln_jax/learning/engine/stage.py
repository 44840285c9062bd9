"""A stretch of a training that is one compiled program, as the loop in `fit` sees it."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jax import Array

from dln_jax.learning.engine.problem import Stop

Dispatch = Callable[[Any], tuple[Any, Array]]
"""state -> state, [loss, validation, monitor] or [seeds, 3]; the given state may be used up."""


class Stage(NamedTuple):
    """States are those of the optimiser: `step` and `best` are all that the loop reads of them."""

    name: str
    start: Callable[[Any], Any]
    """The state in which the stage before ended, `None` for the first -> the state before the first step."""
    compile: Callable[[Any], Dispatch]
    """A state -> some steps and their score, compiled."""
    ended: Callable[[Any], Stop | None]
    """A state -> why the stage is over, `None` while it is not."""
