"""Errors that a user meets. Importing them does not import JAX, so that the help of a command is quick."""

from typing import Any


class InputError(ValueError):
    """Invalid user input; the message states what was wrong, what was expected and what to do."""


class FitRefused(Exception):
    """A fit that must not be used. Its run folder is complete except files for a robot; commands end with status 1."""

    def __init__(self, verdict: Any):
        """Takes a `metrics.verdict.Verdict`."""
        super().__init__(f"the fit is refused: {verdict.reason}; {verdict.remedy}")
        self.verdict = verdict


class ProcessLost(Exception):
    """Another process of the program ended, or the connection to it was lost."""
