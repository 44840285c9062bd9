"""Figure of a training run: loss and errors against steps."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.learning.engine.problem import Progress

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
    for stage in stages:
        for field, (dash, colour, label) in curves.items():
            values = [float(np.median(getattr(at, field))) for at in stage]
            if not np.isnan(values).all():  # no test is monitored
                look = {"marker": "." if len(stage) < 40 else "", "markersize": 4, "color": colour}
                axis.plot([at.step for at in stage], values, dash, **look, label=None if start else label)
                every += values
        if start:
            axis.axvline(start, color="0.4", linewidth=0.8)
        look = {"transform": axis.get_xaxis_transform(), "rotation": 90.0, "color": "0.3", "fontsize": style.SMALL}
        axis.text(start + 0.004 * last, 0.98, stage[0].stage, va="top", **look)
        start = stage[-1].step
    axis.set_yscale(style.scale_of(every))
    axis.axvline(best_step, color="0.6", linestyle=":", label="kept parameters")
    axis.set(xlim=(0, max(1.02 * last, 1)), xlabel="optimiser step", ylabel=unit)
    style.legend(figure, loc="outside lower center", ncols=4)
    return figure
