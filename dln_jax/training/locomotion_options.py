"""Options of train_locomotion. Importing them does not import JAX."""

from dataclasses import dataclass
from typing import Literal

from dln_jax.options import Unstated


@dataclass(frozen=True)
class LocomotionOptions:
    """Creature, task and training."""

    creature: Literal["crawler", "biped", "quadruped", "box-quadruped"] = "crawler"
    """Body of the creature."""
    seed: int = 0
    """First seed, 0 to 4294967295."""
    seeds: int = 1
    """Number of seeds, trained one after the other."""
    steps: Unstated[int] = None
    """Environment steps of each seed (default: 400000)."""
    until: Unstated[float] = None
    """The training of a seed ends at this distance, in body lengths (default: no limit)."""
    upright: float = 0.05
    """Weight of the posture in the reward, body lengths per step."""
    speed: float = 0.04
    """The reward saturates at this speed, body lengths per step; 0 for no limit."""
    clock_period: float = 16.0
    """Period of the policy's clock, in steps of 0.033 s; 0 for no clock."""
    episode: int = 400
    """Length of an episode, in steps of 0.033 s."""
    start: float = 0.01
    """Standard deviation of the vertices' initial positions, m; of their velocities, 10 times as much in m/s."""
    slope: float = 0.0
    """Largest slope of the ground, degrees."""
    rough: float = 0.0
    """Largest height of bumps, m."""
    push: float = 0.0
    """Change of velocity by the pushes, m/s."""
    window: Unstated[int] = None
    """Number of steps that gradients go back (default: 32)."""
    width: int = 64
    """Hidden units of the policy."""
    lanes: Unstated[int] = None
    """Number of creatures simulated side by side, which devices share (default: 4)."""
