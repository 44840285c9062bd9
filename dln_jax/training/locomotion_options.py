"""Options of train_locomotion. Importing them does not import JAX."""

from dataclasses import dataclass
from typing import Literal

from dln_jax.cli.arguments import Unstated


@dataclass(frozen=True)
class LocomotionOptions:
    """What is to be learned."""

    creature: Literal["crawler", "biped", "quadruped"] = "crawler"
    """Which body."""
    seed: int = 0
    """The first seed, 0 to 4294967295."""
    seeds: int = 1
    """How many seeds, one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 40000)."""
    until: Unstated[float] = None
    """Body lengths at which a seed ends (default: no limit)."""
    upright: float = 4.0
    """Weight of the posture in the reward, body lengths per episode."""
    clock_period: float = 16.0
    """Steps of 0.033 s of one turn of the policy's clock."""
    episode: int = 80
    """Steps of 0.033 s."""
    window: Unstated[int] = None
    """Steps that gradients go back; divides the episode (default: 40, for the biped 80)."""
    width: int = 32
    """Hidden units of the policy."""
    lanes: Unstated[int] = None
    """Creatures side by side, in pairs, which devices share (default: 2)."""
