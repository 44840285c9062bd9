"""Why an iteration ended: a number that can be traced, and the sentence that it stands for."""

from enum import IntEnum
from typing import Any

import numpy as np


class Ending(IntEnum):
    """The outcomes of an iteration; an array of their values may be traced, and `reason` gives the words."""

    CONVERGED = 0
    OUT_OF_ITERATIONS = 1
    NO_DESCENT = 2
    NOT_FINITE = 3
    UNDECIDED = 4


REASONS = {
    Ending.CONVERGED: "converged within the tolerance",
    Ending.OUT_OF_ITERATIONS: "used up its iterations before it reached the tolerance; allow more, or start closer",
    Ending.NO_DESCENT: "found no step that improves; scale the problem, or start closer",
    Ending.NOT_FINITE: "met a number that is not finite; start closer, or bound the states and controls",
    Ending.UNDECIDED: "has not ended: a single iteration cannot tell",
}


def reason(ending: Any) -> str:
    """Returns the sentence for an `Ending`, given as such or as a computed array of one element."""
    return REASONS[Ending(int(np.asarray(ending)))]
