"""Options of identify. Importing them does not import JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from dln_jax.options import Unstated, choice
from dln_jax.runs.options import Drawn, Filtered, Folder

IDENTIFIED = ("viscous", "coulomb", "stribeck", "offset", "asymmetric", "sigmoid", "load")
"""Friction laws that can be identified; load only if cross-validation favours it."""
NO_FRICTION = "none"


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The robot, the data, and the way of identification."""

    robot: Path
    """URDF or MJCF file: the kinematics, and values to start from. It is not changed."""
    data: Path
    """Trajectories as npz, CSV or ROS bag, with tau; joint names, if present, are matched with the robot's."""
    test: Unstated[str] = None
    """Held-out trajectories: comma-separated labels; last:30% for the end of every trajectory; or blocks, for ten
    blocks of time in each (default: the third of every five trajectories, or of every five blocks of a single one)."""
    lock: Unstated[str] = None
    """Joints that do not move; "*finger*" matches all names that contain finger (default: all move)."""
    friction: Annotated[str, choice((*IDENTIFIED, NO_FRICTION), several=True)] = "viscous,coulomb,offset"
    """Friction laws to identify (default: viscous,coulomb,offset); load, a share of the torque that a gear carries, is
    left out unless cross-validation favours it."""
    temperature: bool = False
    """Let viscous friction fall with the log's temperature, if cross-validation favours it."""
    motors: Unstated[str] = None
    """Rows of the matrix S of motor rates S qd, if motors turn with several joints (parallelograms, belts), such as
    "1,0,0; 0,1,0; 0,1,1"; armature and friction then act at the motors (default: one motor per joint)."""
    coupled: Unstated[str] = None
    """Pairs of joints, such as 2:3, whose motors share an inertia off the armature's diagonal, for gears of unknown
    ratio; a pair is left out if no motion can show it, or cross-validation does not favour it."""
    velocity_scale: Unstated[float] = None
    """Velocity at which dry friction has three quarters of its force, rad/s or m/s (default: fitted for each joint)."""
    by: Literal["torques", "motions", "both"] = "torques"
    """Fit to torques of filtered motions, to motions simulated with the torques (output error), or to both."""
    window: Unstated[float] = None
    """Length of the simulated windows of --by motions and both, s (default: chosen by inner splits of the training
    data, which may also keep the parameters fitted to torques)."""
    uncertainty: bool = True
    """Estimate the uncertainty of the torques, and flag states out of distribution."""
    residual: bool = False
    """Add a small network for torques that the rigid robot does not explain, if it improves held-out motions."""
    noise: Unstated[str] = None
    """Standard deviation of each joint's torque, N m or N, comma separated (default: estimated)."""
    robust: bool = False
    """Huber's estimate, for torques with spikes."""
    consistent: bool = True
    """Keep bodies physically consistent; otherwise keep the least-squares result."""
    regularisation: float = 1.0
    """Weight of the robot's file for consistent parameters; dimensionless, 1 is about one measurement."""


@dataclass(frozen=True, kw_only=True)
class Options(Drawn, Folder, Filtered, Robot):
    """The robot, the data, how it is identified, and where the results go."""
