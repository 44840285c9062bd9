"""Figure of a training run: loss and errors against steps."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.learning.engine.problem import Progress

SHORTEST_SHARE = 0.2
"""If a stage is shorter than this fraction of the steps, the stage names are vertical."""
OF_LOSSES = {"error": "loss", "loss": "training loss"}
"""Labels of a curve that shows losses."""


def training_curve(
    history: Sequence[Progress],
    *,
    best_step: int,
    error: str = "torque MSE",
    loss: str = "training loss (normalised)",
    unit: str = "loss, or MSE in (N m)²",
) -> Figure:
    """Training loss, validation error and test error against steps; the test error has no influence on the training.

    For several seeds medians are shown. `error` and `loss` name the quantities, `unit` the axis. Stages are named and
    separated by lines; their curves are not connected, since their quantities may differ.
    """
    figure, [[axis]] = style.figure(height=3.6)
    stages = [list(ats) for _, ats in itertools.groupby(history, key=lambda at: at.stage)]
    curves = {
        "loss": ("-", style.SKY, loss),
        "validation": ("--", style.VERMILLION, f"validation {error}"),
        "monitor": ("-", "black", f"test {error}"),
    }
    every, last, start = [], history[-1].step, 0
    upright = min(np.diff([0, *(stage[-1].step for stage in stages)])) < SHORTEST_SHARE * last
    for stage in stages:
        for field, (dash, colour, label) in curves.items():
            values = [float(np.median(getattr(at, field))) for at in stage]
            if not np.isnan(values).all():  # no test is monitored
                look = {"marker": "." if len(stage) < 40 else "", "markersize": 4, "color": colour}
                axis.plot([at.step for at in stage], values, dash, **look, label=None if start else label)
                every += values
        if start:
            axis.axvline(start, color="0.4", linewidth=0.8)
        end = stage[-1].step
        place = (start + 0.004 * last, 0.98) if upright else ((start + end) / 2, 1.02)
        name = axis.text(*place, stage[0].stage, transform=axis.get_xaxis_transform(), color="0.3")
        name.set(fontsize=style.SMALL, rotation=90.0 * upright, ha="left" if upright else "center")
        name.set_va("top" if upright else "bottom")
        start = end
    axis.set_yscale(style.scale_of(every))
    axis.axvline(best_step, color="0.6", linestyle=":", label="kept parameters")
    axis.set(xlim=(0, max(1.02 * last, 1)), xlabel="optimiser step", ylabel=unit)
    style.legend(figure, loc="outside lower center", ncols=4)
    return figure
