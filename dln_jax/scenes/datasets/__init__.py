"""Datasets generated from scenes, and the published tasks."""

from dln_jax.scenes.datasets.generators import CHARACTERS_TEST, characters, free_swing, uniform
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS
from dln_jax.scenes.datasets.letters import LETTERS, LetterPath, letter_path
from dln_jax.scenes.datasets.pendulum_frames import RodFrames, swinging_rod
from dln_jax.scenes.datasets.phase_samples import PhaseSamples, PhaseTask, reference_motion

__all__ = [
    "CHARACTERS_TEST",
    "LETTERS",
    "PROTOCOLS",
    "LetterPath",
    "PhaseSamples",
    "PhaseTask",
    "RodFrames",
    "characters",
    "free_swing",
    "letter_path",
    "reference_motion",
    "swinging_rod",
    "uniform",
]
