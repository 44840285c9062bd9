"""Excitation: Fourier-series motions within a robot's limits that give a well-conditioned regressor."""

from dln_jax.identification.excitation.candidates import Design, random_designs
from dln_jax.identification.excitation.design import (
    CRITERIA,
    as_trajectories,
    best_design,
    design_set,
    error_ratio,
    make_optimiser,
    together,
)
from dln_jax.identification.excitation.fourier import FourierMotion, sampled, state
from dln_jax.identification.excitation.limits import (
    Excess,
    MotionLimits,
    excess,
    heights_above,
    limits_of_robot,
    require_limits,
    used,
)
from dln_jax.identification.excitation.task import Task, make_task

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
