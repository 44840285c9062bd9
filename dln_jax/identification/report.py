"""Reports on an identification: base parameters, all parameters, and findings about the data."""

from typing import Any

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.identification.base import Determinacy
from dln_jax.identification.identify import Identification

STILL = 0.01
"""rad or m: a joint whose range is smaller counts as motionless."""
LARGE_CONDITION = 300.0
"""Above this condition number, errors grow much more along some combinations than along others."""
LONG_CORRELATION = 10.0
"""Correlation time of the residuals in samples, above which they indicate model error rather than noise."""


def base_rows(found: Identification) -> list[dict[str, Any]]:
    """One row per base parameter: the combination, its fitted value, standard error and prior value."""
    values, errors = found.base.combinations @ found.fit.theta, found.fit.standard_errors(found.base.combinations)
    known = found.base.combinations @ found.known
    rows = zip(found.base.words, values.tolist(), errors.tolist(), known.tolist(), strict=True)
    return [
        {"combination": words, "value": value, "standard_error": error, "known": before}
        for words, value, error, before in rows
    ]


def parameter_rows(found: Identification) -> list[dict[str, Any]]:
    """One row per parameter: structure, what the data determine, values, and the standard error if there is one."""
    names, errors = found.columns.names, found.fit.standard_errors(np.eye(len(found.columns.names)))
    return [
        {
            "name": name,
            "structure": found.structure[k],
            "data": found.seen[k],
            "known": float(found.known[k]),
            "least_squares": float(found.fit.theta[k]),
            "standard_error": float(errors[k]) if found.seen[k] == "alone" else None,
            "identified": float(found.theta[k]),
        }
        for k, name in enumerate(names)
    ]


def lost(found: Identification) -> tuple[str, ...]:
    """Names of parameters that some motion could show, but these data do not."""
    return tuple(
        name
        for name, possible, seen in zip(found.columns.names, found.structure, found.seen, strict=True)
        if seen == "not at all" != possible
    )


def findings(found: Identification, data: Trajectories, names: tuple[str, ...]) -> list[str]:
    """Findings about the data, one line each with its remedy."""
    lines = []
    still = np.flatnonzero(np.ptp(data.q, axis=0) < STILL)
    if len(still):
        which = ", ".join(names[k] for k in still)
        lines.append(f"{which}: does not move; what only its motion shows stays as it was; add motions of it")
    if missing := lost(found):
        shown = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
        lines.append(f"not shown by these data, though other motions would: {shown}; vary speeds and postures more")
    if found.fit.condition > LARGE_CONDITION:
        lines.append(f"condition {found.fit.condition:.0f}: motions are much alike; excite the joints more variously")
    times = found.statistics.correlation
    slow = np.flatnonzero(times > LONG_CORRELATION)
    if len(slow):
        which = ", ".join(f"{names[k]} {times[k]:.0f}" for k in slow)
        lines.append(
            f"residuals follow each other, for samples: {which}; rather model error (friction, elasticity) or a filter "
            "than noise; standard errors count such samples once"
        )
    friction = [
        name
        for name, kind, value in zip(found.columns.names, found.columns.kinds, found.fit.theta, strict=True)
        if kind == "positive" and value < 0 and name not in missing
    ]
    if friction and found.consistent is None:
        lines.append(f"negative, which no joint is: {', '.join(friction)}; ask for consistent parameters")
    if found.consistent is not None and not found.consistent.converged:
        lines.append(
            f"the search for physically consistent bodies did not converge in {found.consistent.iterations} "
            "iterations; closer ones may exist"
        )
    return lines


def summary(found: Identification) -> list[str]:
    """How many parameters are identifiable, in two lines."""
    names, structure = found.columns.names, found.structure

    def those(which: Determinacy) -> list[str]:
        return [name for name, each in zip(names, structure, strict=True) if each == which]

    counts = ", ".join(f"{len(those(which))} {which}" for which in ("alone", "in combination", "not at all"))
    return [
        f"{len(names)} parameters, of which motions show {counts}: {len(found.base.words)} base parameters",
        f"these data determine {found.fit.rank} combinations, condition {found.fit.condition:.3g}",
    ]


def text(found: Identification) -> str:
    """The full report as plain text."""
    lines = [*summary(found), "", "base parameters: value ± standard error (before)"]
    for row in base_rows(found):
        lines.append(
            f"  {row['value']:12.5g} ± {row['standard_error']:<9.2g} ({row['known']:.5g})   {row['combination']}"
        )
    lines += ["", "parameter      motions could show  these data show   before       least squares          identified"]
    for row in parameter_rows(found):
        error = "" if row["standard_error"] is None else f"± {row['standard_error']:.2g}"
        lines.append(
            f"{row['name']:<14} {row['structure']:<19} {row['data']:<15} {row['known']:11.5g}  "
            f"{row['least_squares']:11.5g} {error:<10} {row['identified']:11.5g}"
        )
    return "\n".join(lines) + "\n"
