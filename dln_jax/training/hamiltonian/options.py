"""Options of Hamiltonian trainings on images. Importing them does not import JAX."""

from dataclasses import dataclass
from typing import Literal

from dln_jax.options import Unstated
from dln_jax.runs.options import Drawn, Resumable


@dataclass(frozen=True)
class Images:
    """Films of a pendulum, and what is learned from them."""

    model: Literal["black-box-hnn", "phase-network"] = "black-box-hnn"
    """An energy in the latent plane, or a network that gives the rates there."""
    trajectories: Unstated[int] = None
    """Generated films (default: as published)."""
    steps: Unstated[int] = None
    """Steps of adam (default: those of the published recipe)."""
    seed: int = 0
    """Seed of parameters and shuffling."""


@dataclass(frozen=True)
class ImageOptions(Drawn, Resumable, Images):
    """What to train on, how, and where the results go."""
