"""Findings about data: observation, severity and remedy."""

from collections.abc import Iterable, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
"""error: a model learned from the data would be wrong, so commands that learn stop; warning: it would be less accurate
than possible; note: for information."""


class Finding(NamedTuple):
    """A finding, shown to the user as one line."""

    severity: Severity
    check: str
    """Stable lower-case name of the check."""
    observation: str
    """The observation, with numbers."""
    remedy: str
    joints: tuple[int, ...] = ()
    """Joints concerned, counted from 0; empty if the finding concerns the whole log."""

    @property
    def line(self) -> str:
        """The finding as one line of text."""
        return f"{self.severity}: {self.observation}; {self.remedy}"


def on_joints(
    severity: Severity, check: str, concerned: Bool[np.ndarray, " d"], observation: str, remedy: str
) -> list[Finding]:
    """A finding about the joints in a mask, whose names replace {} in the observation; empty without such joints."""
    joints = tuple(map(int, np.flatnonzero(concerned)))
    return [Finding(severity, check, observation.replace("{}", named(joints), 1), remedy, joints)] if joints else []


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Sorts findings by severity."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def named(joints: Sequence[int] | Int[np.ndarray, " j"]) -> str:
    """Formats joints as "joint 3" or "joints 1, 2 and 4", counted from 1 as in figures."""
    numbers = [str(joint + 1) for joint in joints]
    if len(numbers) == 1:
        return f"joint {numbers[0]}"
    return f"joints {', '.join(numbers[:-1])} and {numbers[-1]}"
