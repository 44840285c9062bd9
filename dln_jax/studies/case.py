"""Cases of a report: a number that was measured, and what theory lets one expect of it."""

from typing import Any, NamedTuple

import numpy as np

from dln_jax.studies.report import Row


class Case(NamedTuple):
    """One expectation, and what was found."""

    name: str
    """Stable, lower case: subject/instance."""
    quantity: str
    """What `got` is."""
    expected: str
    """The expectation in words, with where the bound comes from."""
    got: float
    bound: float
    unit: str = "1"
    at_least: bool = False
    """Whether the bound is a lower one."""
    reference: float | None = None
    """The closed-form value, where there is one."""

    @property
    def row(self) -> Row:
        """The case as a row of a report."""
        reference, bound, at_least = self.reference, self.bound, self.at_least
        return Row(self.name, self.quantity, self.got, self.unit, reference, bound, at_least=at_least)

    @property
    def passed(self) -> bool:
        """Whether the bound is met; NaN meets none."""
        return bool(self.row.passed)


class Findings(NamedTuple):
    """The cases of one subject, and the curves that a figure draws of it."""

    cases: list[Case]
    curves: dict[str, Any] = {}  # noqa: RUF012  never written to
    """Name -> array, or arrays by name; see the `figures` of the cases' package."""


def largest(values: Any) -> float:
    """The largest of some numbers; NaN if one is NaN, so that it meets no bound."""
    return float(np.max(np.asarray(values, np.float64)))
