"""A finding: what was seen in the data, how bad it is, and what to do about it."""

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Int

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""error: what is learned would be wrong, so that commands that learn stop; warning: worse than it need be; note: good
to know."""


class Finding(NamedTuple):
    """One line for a user."""

    severity: Severity
    check: str
    """Stable lower-case name of what was looked at."""
    said: str
    """What was seen, with numbers."""
    remedy: str
    """What to do."""
    joints: tuple[int, ...] = ()
    """Counted from 0; none where it is about all."""

    @property
    def line(self) -> str:
        """All of it."""
        return f"{self.severity}: {self.said}; {self.remedy}"


def told(findings: Iterable[Finding]) -> list[Finding]:
    """In the order of severity."""
    return sorted(findings, key=lambda each: SEVERITIES.index(each.severity))


def named(joints: Sequence[int] | Int[np.ndarray, " j"]) -> str:
    """ "joint 3" or "joints 1, 2 and 4", counted from 1 as figures do."""
    numbers = [str(joint + 1) for joint in joints]
    if len(numbers) == 1:
        return f"joint {numbers[0]}"
    return f"joints {', '.join(numbers[:-1])} and {numbers[-1]}"
