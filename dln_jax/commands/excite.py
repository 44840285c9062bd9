"""Design motions that show a robot's parameters: Fourier series within its limits, the best by gradients.

Each motion starts and ends at rest and may be repeated. Several are for identification, each optimised to complement
those before it, and one is for validation. Predicted torques come from the file's inertias and friction, and from a
payload. Writes a run folder: excitation.npz (the schema of trajectories), a CSV file for each motion (t, q, qd),
motions.json (the series), excitation.png, metrics.json and config.json. Limits are those of the file unless options
state them. A list of numbers has one for each joint.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from dln_jax.options import Unstated, choice
from dln_jax.runs.options import Drawn, Folder

VALIDATION = "validation"


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn):
    """Robot, motions and limits."""

    robot: Path
    """URDF or MJCF file; its meshes may be missing."""
    seconds: float = 20.0
    """Length of each motion, which is its period, s."""
    harmonics: int = 5
    """Harmonics of the series; the highest frequency is harmonics / seconds, Hz."""
    rate: float = 100.0
    """Sampling rate of the written motions, Hz."""
    trajectories: int = 3
    """Number of motions for identification; one more is for validation."""
    starts: int = 4
    """Number of random starting motions for each optimised motion."""
    criterion: Annotated[str, choice(("information", "condition"))] = "information"
    """information: minimise the product of the parameters' errors; condition: the regressor's condition number."""
    friction: bool = True
    """Include viscous and dry friction and an offset of each joint in the parameters."""
    velocity_scale: float = 0.05
    """Velocity at which dry friction has 76 % of its force, rad/s or m/s."""
    share: float = 0.9
    """Share of every limit to use; the rest is left to the controller."""
    position: Unstated[str] = None
    """Half the range of positions about zero, rad or m (default: the file's)."""
    velocity: Unstated[str] = None
    """Velocity limits, rad/s or m/s (default: those of a URDF)."""
    acceleration: Unstated[str] = None
    """Acceleration limits, rad/s² or m/s² (default: full velocity in 0.2 s)."""
    torque: Unstated[str] = None
    """Torque limits, N m or N (default: the file's)."""
    allow_unlimited: Unstated[str] = None
    """Comma-separated joints that may lack limits of position and torque; "*wheel*" matches all names that contain
    wheel. Positions are then limited to pi on either side (default: such joints are refused)."""
    noise: str = "1"
    """Standard deviation of the torque's noise; only the ratios of joints matter."""
    height: Unstated[float] = None
    """Height of a plane, m; the origins of all moving links stay above it (default: no plane)."""
    payload: Unstated[float] = None
    """Mass fixed to the last link, kg (default: 0)."""
    payload_position: str = "0,0,0"
    """Centre of the payload in the frame of the last joint, m."""
    seed: int = 0
    """Seed of the starts."""


def main(options: Arguments) -> None:
    """Designs the motions, writes them and prints a summary."""
    from dln_jax.training.excitation import excite

    excite(options)
