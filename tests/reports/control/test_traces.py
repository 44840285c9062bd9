"""Runs survive the report's file and are drawn from it; starts are counted from anywhere."""

import json

import numpy as np

from scripts.reports.control import traces
from scripts.reports.control.cases import SWING_UPS


def test_traces_are_drawn_from_numbers(monkeypatch):
    monkeypatch.setattr(traces, "SECONDS", 0.2)
    monkeypatch.setattr(traces, "SHOWN", 2)
    case = SWING_UPS["rotary-pendulum"]
    curves = json.loads(json.dumps(traces.traces(case)))
    arm, pole, control, energy = traces.draw_traces(curves).axes
    limits = sorted(float(line.get_ydata()[0]) for line in control.lines[1:])
    assert limits == [-case.limit, case.limit] and np.abs(control.lines[0].get_ydata()).max() <= case.limit
    assert len(arm.lines) == len(pole.lines) == len(energy.lines) == 3


def test_starts_are_drawn_from_numbers():
    curves = {"angle": [0.1, 2.0], "rate": [0.0, 1.0], "seconds": [0.5, float("inf")]}
    assert "1 of 2" in traces.draw_starts(curves).axes[0].get_title(loc="left")
