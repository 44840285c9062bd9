"""Metrics of a model: errors, rollouts, definiteness, misfit, latency, coverage."""

from dln_jax.errors import FitRefused
from dln_jax.metrics.coverage import Coverage, coverage
from dln_jax.metrics.definiteness import Definiteness, definiteness
from dln_jax.metrics.errors import errors, mean_square, normalised_error, predictions
from dln_jax.metrics.frames import Injection, inject_energy
from dln_jax.metrics.latency import Latency, medians_in_turns, one_step
from dln_jax.metrics.misfit import Misfit, velocity_misfit
from dln_jax.metrics.phase_space import Motions, field_errors, motion_errors, predict, summary
from dln_jax.metrics.rollouts import (
    Motion,
    energy_error,
    follow,
    normalised_state_error,
    recorded_motions,
    rollout_metrics,
    valid_prediction_time,
    valid_prediction_times,
)
from dln_jax.metrics.soft_body_energies import motion_energies
from dln_jax.metrics.verdict import HeldOut, Verdict, held_out, judge

__all__ = [
    "Coverage",
    "Definiteness",
    "FitRefused",
    "HeldOut",
    "Injection",
    "Latency",
    "Misfit",
    "Motion",
    "Motions",
    "Verdict",
    "coverage",
    "definiteness",
    "energy_error",
    "errors",
    "field_errors",
    "follow",
    "held_out",
    "inject_energy",
    "judge",
    "mean_square",
    "medians_in_turns",
    "motion_energies",
    "motion_errors",
    "normalised_error",
    "normalised_state_error",
    "one_step",
    "predict",
    "predictions",
    "recorded_motions",
    "rollout_metrics",
    "summary",
    "valid_prediction_time",
    "valid_prediction_times",
    "velocity_misfit",
]
