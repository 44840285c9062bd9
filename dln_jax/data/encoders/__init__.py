"""Logs of encoders: q, t and tau at a rate of one's own, with noise, become trajectories with rates.

`smooth(data)` resamples, filters without delay, differentiates, trims and decimates; it says what it chose.
"""

from dln_jax.data.encoders.cutoff import Choice, choose_cutoff
from dln_jax.data.encoders.filters import derivatives, low_pass
from dln_jax.data.encoders.noise import noise_of, step_of, torque_noise
from dln_jax.data.encoders.smoothing import Smoothed, labels_of_parts, smooth

__all__ = [
    "Choice",
    "Smoothed",
    "choose_cutoff",
    "derivatives",
    "labels_of_parts",
    "low_pass",
    "noise_of",
    "smooth",
    "step_of",
    "torque_noise",
]
