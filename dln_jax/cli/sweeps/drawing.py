"""Figure of a sweep: which options set colours and markers, and which runs become points."""

from collections.abc import Mapping, Sequence

from matplotlib.figure import Figure

from dln_jax.cli.sweeps.results import ERRORS, PROBLEM, Entry, Group, Names, problem_of, shown
from dln_jax.cli.sweeps.tables import spaced
from dln_jax.figures.sweeps import Point, error_against_seconds

MOST_PANELS = 6
"""Largest number of problems drawn in panels of their own."""


def drawn(
    found: Sequence[Entry],
    best: Sequence[Entry],
    of: Sequence[Group],
    over: Sequence[str],
    names: Names,
    *,
    beside: int | None,
) -> Figure | None:
    """Draws test error against training time; `None` if no job has both.

    Args:
        found: all jobs.
        best: jobs to mark with a ring.
        of: groups of jobs; their medians are drawn if the grid has an option of `over`.
        over: options that medians are taken over.
        names: names of the metrics.
        beside: number of jobs that ran at once, if known.
    """
    if not names.error or not names.seconds:
        return None
    problems = {problem_of(entry.job.values) for entry in found}
    panels = len(problems) <= MOST_PANELS and len(found) > len(problems)
    shown_by = [name for name in found[0].job.values if name not in (*over, *(PROBLEM if panels else ()))]
    colour, marker = (*shown_by, "", "")[:2]

    def point(values: Mapping[str, str], seconds: float, error: float, **flags: bool) -> Point:
        looks = [shown(values[name]) if name else "" for name in (colour, marker)]
        return Point(seconds, error, *looks, problem=", ".join(problem_of(values)) if panels else "", **flags)

    points = []
    for entry in found:
        seconds, error = entry.number(names.seconds), entry.number(names.error)
        if seconds is not None and error is not None:
            points.append(point(entry.job.values, seconds, error, best=entry in best))
    if any(name in found[0].job.values for name in over):
        points += [
            point(group.values, group.medians[names.seconds], group.medians[names.error], median=True)
            for group in of
            if names.seconds in group.medians and names.error in group.medians
        ]
    if not points:
        return None
    side = "" if beside is None else f", {beside} jobs at once" if beside > 1 else ", one job at a time"
    return error_against_seconds(
        points,
        x=f"{names.seconds.removesuffix('_seconds').replace('train', 'training')}, s{side}",
        y="test " * (names.error in ERRORS) + spaced(names.error),
        colour=spaced(colour),
        marker=spaced(marker),
        note=undone(found),
    )


def undone(found: Sequence[Entry]) -> str:
    """Counts of the jobs that are not done, by state; empty if all are done."""
    states = [entry.status.state for entry in found if entry.status.state != "done"]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    return f"{len(found)} jobs, of which {counts}" if states else ""
