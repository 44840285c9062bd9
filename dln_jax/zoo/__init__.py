"""The model zoo: models by name, their descriptions, and trained models saved to and loaded from folders."""

from dln_jax.zoo.catalogue import CATALOGUE, Entry, Properties
from dln_jax.zoo.descriptions import build, describe, describe_for, typical_sizes
from dln_jax.zoo.run import Run, compiled, load, save
from dln_jax.zoo.uncertainty_files import save_uncertainty

__all__ = [
    "CATALOGUE",
    "Entry",
    "Properties",
    "Run",
    "build",
    "compiled",
    "describe",
    "describe_for",
    "load",
    "save",
    "save_uncertainty",
    "typical_sizes",
]
