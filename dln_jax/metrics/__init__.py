"""Metrics of a model: errors, rollouts, definiteness, latency, coverage."""

from dln_jax.errors import FitRefused
from dln_jax.metrics.coverage import Coverage, coverage
from dln_jax.metrics.definiteness import Definiteness, definiteness
from dln_jax.metrics.errors import errors, mean_square, normalised_error
from dln_jax.metrics.frames import Injection, inject_energy
from dln_jax.metrics.latency import Latency, one_step
from dln_jax.metrics.phase_space import Motions, field_errors, motion_errors, predict, summary
from dln_jax.metrics.rollouts import (
    Motion,
    follow,
    normalised_state_error,
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
    "Motion",
    "Motions",
    "Verdict",
    "coverage",
    "definiteness",
    "errors",
    "field_errors",
    "follow",
    "held_out",
    "inject_energy",
    "judge",
    "mean_square",
    "motion_energies",
    "motion_errors",
    "normalised_error",
    "normalised_state_error",
    "one_step",
    "predict",
    "summary",
    "valid_prediction_time",
    "valid_prediction_times",
]
