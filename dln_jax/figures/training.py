"""Figure of a training: loss and errors against steps."""

import itertools
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from dln_jax.figures import style
from dln_jax.learning.engine.problem import Progress

LEAST_SHARE = 0.2
"""Stages shorter than this fraction of the steps make the stage names vertical."""


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
    kinds = (
        ("loss", "-", style.SKY, loss),
        ("validation", "--", style.VERMILLION, f"validation {error}"),
        ("monitor", "-", "black", f"test {error}"),
    )
    every = []
    for number, stage in enumerate(stages):
        steps = [at.step for at in stage]
        for field, style_of_line, colour, label in kinds:
            values = [float(np.median(getattr(at, field))) for at in stage]
            if not np.isnan(values).all():  # no test is monitored
                marker = "." if len(stage) < 40 else ""
                named = {"label": label} if number == 0 else {}
                axis.plot(steps, values, style_of_line, marker=marker, markersize=4, color=colour, **named)
                every += values
    axis.set_yscale(style.scale_of(every))
    axis.axvline(best_step, color="0.6", linestyle=":", label="kept parameters")
    last = history[-1].step
    axis.set_xlim(0, max(1.02 * last, 1))
    starts = [0, *(stage[-1].step for stage in stages[:-1])]
    lengths = np.diff([*starts, last])
    upright = bool(np.any(lengths < LEAST_SHARE * last))
    for start, length, stage in zip(starts, lengths, stages, strict=True):
        if start:
            axis.axvline(start, color="0.4", linewidth=0.8)
        if upright:
            place, turned = (start + 0.004 * last, 0.98), {"rotation": 90.0, "ha": "left", "va": "top"}
        else:
            place, turned = (start + length / 2, 1.02), {"rotation": 0.0, "ha": "center", "va": "bottom"}
        name = axis.text(*place, stage[0].stage, transform=axis.get_xaxis_transform(), color="0.3")
        name.update({"fontsize": style.SMALL, **turned})
    axis.set(xlabel="optimiser step", ylabel=unit)
    style.legend(figure, loc="outside lower center", ncols=4)
    return figure
