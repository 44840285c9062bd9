"""Runs and outcomes of swing-ups are drawn."""

import numpy as np

from scripts.reports.control import swing_ups


def test_traces_are_drawn():
    case = swing_ups.SWING_UPS["rotary-pendulum"]
    arm, pole, control, energy = swing_ups.draw_traces(swing_ups.traces(case, count=2, seconds=0.2)).axes
    limits = sorted(float(line.get_ydata()[0]) for line in control.lines[1:])
    assert limits == [-case.limit, case.limit] and np.abs(control.lines[0].get_ydata()).max() <= case.limit
    assert len(arm.lines) == len(pole.lines) == len(energy.lines) == 3


def test_starts_are_drawn_from_numbers():
    curves = {"x": [[0.1, 0.0], [2.0, 1.0]], "seconds": [0.5, float("inf")]}
    assert "1 of 2" in swing_ups.draw_starts(curves).axes[0].get_title(loc="left")
