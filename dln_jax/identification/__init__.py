"""From a robot and its logs to parameters: motions that show them, and what the data say of them."""

from dln_jax.identification.excitation import (
    CRITERIA,
    as_trajectories,
    best_design,
    design_set,
    error_ratio,
    make_optimiser,
    together,
)
from dln_jax.identification.excitation_designs import Design, random_designs
from dln_jax.identification.excitation_task import Task, make_task
from dln_jax.identification.fourier import FourierMotion, sampled, state
from dln_jax.identification.motion_limits import (
    Excess,
    MotionLimits,
    excess,
    heights_above,
    limits_of_robot,
    require_limits,
    used,
)

__all__ = [
    "CRITERIA",
    "Design",
    "Excess",
    "FourierMotion",
    "MotionLimits",
    "Task",
    "as_trajectories",
    "best_design",
    "design_set",
    "error_ratio",
    "excess",
    "heights_above",
    "limits_of_robot",
    "make_optimiser",
    "make_task",
    "random_designs",
    "require_limits",
    "sampled",
    "state",
    "together",
    "used",
]
