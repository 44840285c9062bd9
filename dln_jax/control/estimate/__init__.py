"""State estimation: Kalman filters, a moving horizon, filters in control loops, and external torques.

    process = mechanical(model, B, rate=500.0, band=[0.3, 1e-3], encoder_step=[2.3e-5, 3.1e-3])
    controller = with_estimate(law, extended(process), belief(x, 0.1), controls=1, measurements=2, delay=1)

`extended`, `unscented` and `moving_horizon` make filters of a process. All have the same three pure functions `start`,
`predict` and `update`, for one state.
"""

from dln_jax.control.estimate.extended import extended
from dln_jax.control.estimate.external import (
    Momentum,
    MomentumObserver,
    Wrench,
    contact_score,
    contact_threshold,
    flange_wrench,
    momentum_observer,
    observed,
)
from dln_jax.control.estimate.horizon import Window, moving_horizon
from dln_jax.control.estimate.loop import Estimating, filtered, with_estimate
from dln_jax.control.estimate.process import Belief, Filter, Innovation, Process, belief, mechanical
from dln_jax.control.estimate.tuning import Tuned, consistency, from_log, surprise, tuned
from dln_jax.control.estimate.unscented import unscented

__all__ = [
    "Belief",
    "Estimating",
    "Filter",
    "Innovation",
    "Momentum",
    "MomentumObserver",
    "Process",
    "Tuned",
    "Window",
    "Wrench",
    "belief",
    "consistency",
    "contact_score",
    "contact_threshold",
    "extended",
    "filtered",
    "flange_wrench",
    "from_log",
    "mechanical",
    "momentum_observer",
    "moving_horizon",
    "observed",
    "surprise",
    "tuned",
    "unscented",
    "with_estimate",
]
