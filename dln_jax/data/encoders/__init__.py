"""Encoder logs: convert noisy q, t and tau at an arbitrary rate to trajectories with derivatives.

`smooth(data)` resamples, filters without delay, differentiates, trims and decimates, and reports the settings chosen.
`smooth_locally(data)` does without equal steps, for motions of a few dozen samples.
"""

from dln_jax.data.encoders.clock import Clock, source_clock
from dln_jax.data.encoders.cutoff import Choice, choose_cutoff
from dln_jax.data.encoders.filters import derivatives, low_pass
from dln_jax.data.encoders.local_polynomials import LocalRates, smooth_locally
from dln_jax.data.encoders.repeats import Repeats, find_repeats, without_repeats
from dln_jax.data.encoders.sampling import held_at_equal_steps, noise_of, step_of, torque_noise
from dln_jax.data.encoders.smoothing import Smoothed, labels_of_parts, smooth

__all__ = [
    "Choice",
    "Clock",
    "LocalRates",
    "Repeats",
    "Smoothed",
    "choose_cutoff",
    "derivatives",
    "find_repeats",
    "held_at_equal_steps",
    "labels_of_parts",
    "low_pass",
    "noise_of",
    "smooth",
    "smooth_locally",
    "source_clock",
    "step_of",
    "torque_noise",
    "without_repeats",
]
