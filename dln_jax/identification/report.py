"""Reports on an identification: base parameters, all parameters, and findings about the data."""

from typing import Any, get_args

import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.identification.base import Determinacy
from dln_jax.identification.identify import Identification

STILL = 0.01
"""rad or m: a joint whose range is smaller counts as motionless."""
LARGE_CONDITION = 300.0
"""Above this condition number, errors grow much more along some combinations than along others."""
LONG_CORRELATION = 10.0
"""Residuals with a longer correlation time, in samples, indicate model error rather than noise."""


def base_rows(result: Identification) -> list[dict[str, Any]]:
    """One row per base parameter: the combination, its fitted value, standard error and prior value."""
    values, errors = result.base.combinations @ result.fit.theta, result.fit.standard_errors(result.base.combinations)
    known = result.base.combinations @ result.known
    keys = ("combination", "value", "standard_error", "known")
    rows = zip(result.base.words, values.tolist(), errors.tolist(), known.tolist(), strict=True)
    return [dict(zip(keys, row, strict=True)) for row in rows]


def parameter_rows(result: Identification) -> list[dict[str, Any]]:
    """One row per parameter: structure, what the data determine, values, and the standard error if there is one."""
    names, errors = result.columns.names, result.fit.standard_errors(np.eye(len(result.columns.names)))
    return [
        {
            "name": name,
            "structure": result.structure[k],
            "data": result.seen[k],
            "known": float(result.known[k]),
            "least_squares": float(result.fit.theta[k]),
            "standard_error": float(errors[k]) if result.seen[k] == "alone" else None,
            "identified": float(result.theta[k]),
        }
        for k, name in enumerate(names)
    ]


def lost(result: Identification) -> tuple[str, ...]:
    """Names of parameters that some motion could show, but these data do not."""
    return tuple(
        name
        for name, possible, seen in zip(result.columns.names, result.structure, result.seen, strict=True)
        if seen == "not at all" != possible
    )


def findings(result: Identification, data: Trajectories, names: tuple[str, ...]) -> list[str]:
    """Findings about the data, one line each with its remedy."""
    lines = []
    still = np.flatnonzero(np.ptp(data.q, axis=0) < STILL)
    if len(still):
        which = ", ".join(names[k] for k in still)
        lines.append(f"{which}: does not move; parameters that only its motion shows keep their values; record motions")
    if missing := lost(result):
        shown = ", ".join(missing[:12]) + (f" and {len(missing) - 12} more" if len(missing) > 12 else "")
        lines.append(f"determined by other motions, but not by these data: {shown}; vary speeds and postures more")
    if result.fit.condition > LARGE_CONDITION:
        lines.append(f"condition {result.fit.condition:.0f}: the motions are too similar; vary them more")
    times = result.correlation
    slow = np.flatnonzero(times > LONG_CORRELATION)
    if len(slow):
        which = ", ".join(f"{names[k]} {times[k]:.0f}" for k in slow)
        lines.append(
            f"residuals are correlated over many samples ({which}), by model errors (friction, elasticity) or a filter "
            "rather than noise; standard errors count such samples once"
        )
    negative = [
        name
        for name, kind, value in zip(result.columns.names, result.columns.kinds, result.fit.theta, strict=True)
        if kind == "positive" and value < 0 and name not in missing
    ]
    if negative and result.consistent is None:
        lines.append(f"negative friction or armature: {', '.join(negative)}; ask for physically consistent parameters")
    if result.consistent is not None and not result.consistent.converged:
        lines.append(
            f"the search for physically consistent bodies did not converge in {result.consistent.iterations} "
            "iterations; closer ones may exist"
        )
    return lines


def summary(result: Identification) -> list[str]:
    """How many parameters are identifiable, in two lines."""
    counts = ", ".join(f"{result.structure.count(kind)} {kind}" for kind in get_args(Determinacy))
    return [
        f"{len(result.structure)} parameters; motions determine {counts}: {len(result.base.words)} base parameters",
        f"these data determine {result.fit.rank} combinations, condition {result.fit.condition:.3g}",
    ]


def text(result: Identification) -> str:
    """The full report as plain text."""
    lines = [*summary(result), "", "base parameters: value ± standard error (before)"]
    for row in base_rows(result):
        lines.append(
            f"  {row['value']:12.5g} ± {row['standard_error']:<9.2g} ({row['known']:.5g})   {row['combination']}"
        )
    lines += ["", "parameter      motions could show  these data show   before       least squares          identified"]
    for row in parameter_rows(result):
        error = "" if row["standard_error"] is None else f"± {row['standard_error']:.2g}"
        lines.append(
            f"{row['name']:<14} {row['structure']:<19} {row['data']:<15} {row['known']:11.5g}  "
            f"{row['least_squares']:11.5g} {error:<10} {row['identified']:11.5g}"
        )
    return "\n".join(lines) + "\n"
