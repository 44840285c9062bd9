"""Options of identify. Importing them does not import JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from dln_jax.cli.arguments import Unstated, choice
from dln_jax.cli.options import Drawn, Filtered, Folder

IDENTIFIED = ("viscous", "coulomb", "stribeck", "offset", "asymmetric", "sigmoid")
"""Friction laws in whose coefficients forces are linear."""
NO_FRICTION = "none"


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The robot, the data, and how it is identified."""

    robot: Path
    """URDF or MJCF file: the kinematics, and values to start from. It is not changed."""
    data: Path
    """Trajectories as npz, CSV or ROS bag, with tau; joint names, if present, are matched with the robot's."""
    test: Unstated[str] = None
    """Held-out trajectories: labels, comma separated; last:30% of every trajectory; or blocks, of ten blocks of time
    (default: the third of every five; of one trajectory, of ten blocks of time)."""
    lock: Unstated[str] = None
    """Joints that do not move; "*finger*" names all with finger in their name (default: all move)."""
    friction: Annotated[str, choice((*IDENTIFIED, NO_FRICTION), several=True)] = "viscous,coulomb,offset"
    """Friction laws whose coefficients are identified (default: viscous,coulomb,offset)."""
    velocity_scale: Unstated[float] = None
    """Velocity at which dry friction has three quarters of its force, rad/s or m/s (default: fitted for each joint)."""
    by: Literal["torques", "motions", "both"] = "torques"
    """What is fitted: torques of filtered motions, motions simulated with the torques (output error), or both."""
    window: Unstated[float] = None
    """Length of the simulated windows of --by motions and both, s (default: 0.3)."""
    uncertainty: bool = True
    """Estimate the uncertainty of the torques, and flag states out of distribution."""
    residual: bool = False
    """Add a small network for what the rigid robot leaves unexplained, if held-out motions ask for one."""
    noise: Unstated[str] = None
    """Standard deviation of each joint's torque, N m or N, comma separated (default: estimated)."""
    robust: bool = False
    """Huber's estimate, for torques with spikes."""
    consistent: bool = True
    """Keep bodies physically consistent; else keep what least squares gives."""
    regularisation: float = 1.0
    """Weight of the robot's file for consistent parameters; dimensionless, 1 is about one measurement."""


@dataclass(frozen=True, kw_only=True)
class Options(Drawn, Folder, Filtered, Robot):
    """The robot, the data, how it is identified, and where the results go."""
