"""Environment steps and seconds until a policy reaches a distance, and the figure of its learning."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.locomotion.learning import Record

COLOURS = {"gradient": style.BLUE, "evolution": style.GREEN}


def first_reaching(records: Sequence[Record], distance: float) -> Record | None:
    """First evaluation of a seed that reached the distance; `None` if none did."""
    return next((record for record in records if record.distance >= distance), None)


def median_to_reach(seeds: Sequence[Sequence[Record]], distance: float, field: str) -> float:
    """Median over seeds of the "steps" or "seconds" to the distance; infinite if at least half never reached it."""
    found = [first_reaching(records, distance) for records in seeds]
    return float(np.median([math.inf if record is None else getattr(record, field) for record in found]))


def learning_figure(seeds: Sequence[Sequence[Record]], *, method: str) -> Figure:
    """Distance of every evaluation against environment steps, with a line per seed."""
    figure, [[axis]] = style.figure(height=3.4)
    for records in seeds:
        steps, distances = [record.steps for record in records], [record.distance for record in records]
        axis.plot(steps, distances, color=COLOURS.get(method, style.PURPLE), linewidth=1.2, alpha=0.8)
    axis.axhline(1.0, color="0.6", linewidth=0.8, linestyle="--")
    axis.set(xlabel="environment steps", ylabel="distance in one episode, body lengths")
    style.title(axis, f"{method}, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}")
    return figure
