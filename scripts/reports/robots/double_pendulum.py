"""A real double pendulum with motors: nine recordings of `design_A.0` (DFKI, BSD 3-Clause), some held out.

A planar chain of ten parameters (two moments of inertia, their coupling, the second motor's armature, two weights,
viscous and dry friction of both joints) is fitted in the ways of `double_pendulum_fits` from q, t and tau. It is judged
by torques of filtered motions and by its valid prediction time.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dln_jax.data.encoders import smooth
from dln_jax.data.schema import load
from dln_jax.metrics.measured_predictions import cut_segments, predict_measured, valid_times
from scripts.reports.robots.arm import torque_of
from scripts.reports.robots.double_pendulum_fits import (
    CUTOFF,
    RATE,
    WINDOW,
    Fitted,
    Logs,
    choose_scale,
    fit_both,
    fit_low_passed,
    fit_motions,
    fit_stacked,
    fit_torques,
)
from scripts.reports.rows import Row

FINE, BASE = 30.0, 500.0
"""Cut-off that keeps the motion, and approximate rate of the recordings, Hz."""
TRIM = 0.3
"""Time left out at both ends of a recording, s."""
HORIZON, EVERY = 2.2, 0.5
"""Length of predicted segments, and interval of their starts, s."""
HELD_OUT = (("02", "11"), ("00", "12"), ("04", "13"), ("01", "05"), ("03", "13"))
"""Held-out recordings, by split."""
WAYS = ("least-squares", "chosen-scale", "low-passed", "stacked", "motions", "both")
QUANTITIES = {"torque_nmse": ("1", False), "vpt_mean_seconds": ("s", True)}
"""Unit of a quantity, and whether larger is better."""

Numbers = dict[str, float]


def rows(path: Path, held_out: Sequence[Sequence[str]] = HELD_OUT) -> list[Row]:
    """Torque errors and valid prediction times on held-out recordings by method: median, worst, and by split.

    The results of least squares bound the other methods. `torque_nmse` is the error along filtered motions.
    """
    logs = read(path)
    splits = [split_numbers(logs, labels) for labels in held_out]
    listed = []
    for way in WAYS:
        for quantity, (unit, longer) in QUANTITIES.items():
            values, rival = ([numbers[name][quantity] for numbers in splits] for name in (way, WAYS[0]))
            of_splits = {f"_{'_'.join(labels)}": lambda values, n=n: values[n] for n, labels in enumerate(held_out)}
            for suffix, of in {"": np.median, "_worst": np.min if longer else np.max, **of_splits}.items():
                bound = float(of(rival)) if way != WAYS[0] else None
                row = Row(f"double-pendulum/{way}", quantity + suffix, float(of(values)), unit, None, bound, longer)
                listed.append(row)
    return listed


def split_numbers(logs: Logs, held_out: Sequence[str]) -> dict[str, Numbers]:
    """Numbers by method and quantity, with the recordings of these labels held out."""
    index = {label: place for place, label in enumerate(logs.fine.label)}
    test = [index[label] for label in held_out]
    rest = logs.of(index for index in np.unique(logs.fine.trajectory) if index not in test)
    scale = choose_scale(rest)
    fits = (
        fit_torques(rest),
        fit_torques(rest, scale),
        fit_low_passed(rest, scale)[0],
        fit_stacked(rest, scale),
        fit_motions(rest, scale),
        fit_both(rest, scale),
    )
    return {way: judged(fitted, logs.of(test), logs) for way, fitted in zip(WAYS, fits, strict=True)}


def judged(fitted: Fitted, held: Logs, every: Logs) -> Numbers:
    """Torque error relative to the variance over all recordings, averaged over joints, and mean prediction time."""
    data, torque = held.coarse, torque_of(*fitted)
    off = torque(data.q, data.qd, data.qdd) - data.tau
    segments = cut_segments(held.fine, round(HORIZON * RATE), every=round(EVERY * RATE))
    predicted = predict_measured(*fitted, segments, fitted=WINDOW)
    times = valid_times(segments, predicted, fitted=WINDOW, variance=every.fine.q.var(axis=0))
    numbers = (float(np.mean(off**2 / every.coarse.tau.var(axis=0))), float(np.mean(times)))
    return dict(zip(QUANTITIES, numbers, strict=True))


def read(path: Path) -> Logs:
    """Reads the recordings, resampled to equal steps, filtered, and trimmed at both ends."""
    data = load(path)
    known = {"rate": BASE, "trim": TRIM, "decimate": round(BASE / RATE), "filter_torque": True}
    return Logs(*(smooth(data, cutoff, **known).data for cutoff in (CUTOFF, FINE)))
