"""Options of train_locomotion. Importing them does not import JAX."""

from dataclasses import dataclass
from typing import Literal

from dln_jax.cli.arguments import Unstated


@dataclass(frozen=True)
class LocomotionOptions:
    """What is to be learned."""

    creature: Literal["crawler", "biped", "quadruped", "box-quadruped"] = "crawler"
    """Which body."""
    seed: int = 0
    """The first seed, 0 to 4294967295."""
    seeds: int = 1
    """How many seeds, one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 400000)."""
    until: Unstated[float] = None
    """Body lengths at which a seed ends (default: no limit)."""
    upright: float = 0.05
    """Weight of the posture in the reward, body lengths per step."""
    speed: float = 0.04
    """Speed far above which is hardly rewarded, body lengths per step; 0 for no limit."""
    clock_period: float = 16.0
    """Steps of 0.033 s of one turn of the policy's clock; 0 for no clock."""
    episode: int = 400
    """Steps of 0.033 s."""
    start: float = 0.01
    """Standard deviation of the vertices' initial positions, m; of their velocities, 10 times as much in m/s."""
    slope: float = 0.0
    """Largest slope of the ground, degrees."""
    rough: float = 0.0
    """Largest height of bumps, m."""
    push: float = 0.0
    """Change of velocity by the pushes, m/s."""
    window: Unstated[int] = None
    """Steps that gradients go back (default: 32)."""
    width: int = 64
    """Hidden units of the policy."""
    lanes: Unstated[int] = None
    """Creatures side by side, which devices share (default: 4)."""
