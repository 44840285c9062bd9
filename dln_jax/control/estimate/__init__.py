"""State estimation: Kalman filters, filters in control loops, and external torques.

    process = mechanical(model, B, rate=500.0, band=[0.3, 1e-3], encoder_step=[2.3e-5, 3.1e-3])
    controller = with_estimate(law, extended(process), belief(x, 0.1), controls=1, measurements=2, delay=1)

`extended` and `unscented` make filters of a process. Both have the same three pure functions `start`,
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
    "observed",
    "surprise",
    "tuned",
    "unscented",
    "with_estimate",
]
