"""Learning: problems, objectives, and the one loop that solves them.

    training = fit(dynamics.problem(model, split(data)), GaussNewton())

`dynamics`, `rates`, `motions`, `accelerations`, `measured_motions`, `frames` and `functions` build problems. Models
that are linear in their parameters are solved directly. `uncertainty` estimates the uncertainty of a fitted model.
"""

from dln_jax.learning import (
    accelerations,
    dynamics,
    frames,
    functions,
    measured_motions,
    motions,
    rates,
    uncertainty,
)
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton, Optimiser, suited
from dln_jax.learning.engine.problem import Problem, Progress, Stop, Training
from dln_jax.learning.friction import fit_friction
from dln_jax.learning.kernel import choose_kernel, fit_kernel
from dln_jax.learning.linear import choose_degrees, fit_linear
from dln_jax.learning.model_selection import grow
from dln_jax.learning.objectives import BOTH_WAYS, CANONICAL, FORWARD, TORQUE, Objective, objective_of
from dln_jax.learning.online import empty_replay, learn_online, make_linear_refit, make_refit
from dln_jax.learning.rates import match_linear

__all__ = [
    "BOTH_WAYS",
    "CANONICAL",
    "FORWARD",
    "TORQUE",
    "Adam",
    "Checkpoint",
    "GaussNewton",
    "Objective",
    "Optimiser",
    "Problem",
    "Progress",
    "Stop",
    "Training",
    "accelerations",
    "choose_degrees",
    "choose_kernel",
    "dynamics",
    "empty_replay",
    "fit",
    "fit_friction",
    "fit_kernel",
    "fit_linear",
    "frames",
    "functions",
    "grow",
    "identity",
    "learn_online",
    "make_linear_refit",
    "make_refit",
    "match_linear",
    "measured_motions",
    "motions",
    "objective_of",
    "rates",
    "suited",
    "uncertainty",
]
