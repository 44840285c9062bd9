"""Measure how long a chaotic double pendulum is predicted, beside what its Lyapunov exponent allows.

Scores are median times until a prediction is 1 rad off, in units of the time that theory allows.
"""

from scripts.reports.chaos import measure_horizons
from scripts.reports.run import AtLeast, Case

CASES = (
    Case(
        "lyapunov-time/double-pendulum",
        measure_horizons,
        quick={"steps": 40_000},
        published={"horizon_score": 1.0, "horizon_score_upper": 1.0},
        bound={
            "lyapunov_times": AtLeast(10.0),
            "exponents_relative_difference": 1e-3,
            "horizon_score": AtLeast(0.5),
            "horizon_score_upper": 2.0,
        },
    ),
)
