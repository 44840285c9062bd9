"""Reasons why an iteration ended: numbers that can be traced, and their sentences."""

from enum import IntEnum
from typing import Any

import numpy as np


class Ending(IntEnum):
    """Outcomes of an iteration; arrays of them may be traced, and `reason` puts them into words."""

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    NO_DESCENT = 2
    NOT_FINITE = 3
    UNDECIDED = 4
    VIOLATED = 5
    INFEASIBLE = 6
    SADDLE = 7
    EXCEEDED = 8


REASONS = {
    Ending.CONVERGED: "converged within the tolerance",
    Ending.OUT_OF_ITERATIONS: "used up its iterations before it reached the tolerance; allow more, or start closer",
    Ending.NO_DESCENT: "found no step that improves; scale the problem, or start closer",
    Ending.NOT_FINITE: "met a number that is not finite; start closer, or bound the states and controls",
    Ending.VIOLATED: "ended where constraints are violated (`worst_violation` names the worst); start closer, "
    "or make them soft",
    Ending.INFEASIBLE: "is locally infeasible: no small change lowers the violation (`worst_violation` names "
    "the worst); change the limits, the horizon or the start",
    Ending.SADDLE: "ended at a saddle: all slopes vanish, but the cost curves down; start beside it",
    Ending.EXCEEDED: "is optimal at its prices, but violates soft constraints (`worst_violation` names the "
    "worst); raise the prices, or make the constraints hard (soft=None)",
    Ending.UNDECIDED: "has not ended: a single iteration cannot tell",
}


def reason(ending: Any) -> str:
    """Returns the sentence for an `Ending`, or for a one-element array that holds it."""
    return REASONS[Ending(int(np.asarray(ending)))]
