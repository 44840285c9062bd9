"""Identify a robot from its URDF or MJCF file and a log.

Fits base parameters with standard errors, friction, and physically consistent inertias to q, qd, qdd and tau, and
reports what the data do not determine. The run folder gets the model (load it with dln_jax.load, or export it to C),
the robot's file with the identified values, report.txt, parameters.json, metrics.json, config.json and figures.
Held-out trajectories judge the result, or held-out blocks of time if there is only one trajectory.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from dln_jax.options import Drawn, Filtered, Folder, Unstated, choice

LAWS = ("viscous", "coulomb", "stribeck", "offset", "asymmetric", "sigmoid", "load")
"""Friction laws that can be identified; load only if cross-validation favours it."""
TEMPERATURE, NO_FRICTION = "temperature", "none"


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The robot, the data, and the way of identification."""

    robot: Path
    """URDF or MJCF file with the kinematics and starting values. It is not changed."""
    data: Path
    """Trajectories as npz, CSV or ROS bag, with tau; joint names, if present, are matched with the robot's."""
    test: Unstated[str] = None
    """Held-out trajectories: comma-separated labels; last:30% for the end of every trajectory; or blocks, for ten
    blocks of time in each (default: the third of every five trajectories, or of every five blocks of a single one)."""
    lock: Unstated[str] = None
    """Joints that do not move; "*finger*" matches all names that contain finger (default: all move)."""
    friction: Annotated[str, choice((*LAWS, TEMPERATURE, NO_FRICTION), several=True)] = "viscous,coulomb,offset"
    """Friction laws to identify (default: viscous,coulomb,offset). Load (friction that grows with the torque in the
    gear) and temperature (viscous friction that falls with it) are kept only if cross-validation favours them."""
    motors: Unstated[str] = None
    """Rows of the matrix S of motor rates S qd, if motors turn with several joints (parallelograms, belts), such as
    "1,0,0; 0,1,0; 0,1,1"; armature and friction then act at the motors (default: one motor per joint)."""
    coupled: Unstated[str] = None
    """Pairs of joints, such as 2:3, whose motors share an inertia (an off-diagonal entry of the armature), for gears of
    unknown ratio; a pair is dropped if no motion shows it or cross-validation does not favour it."""
    velocity_scale: Unstated[float] = None
    """Velocity at which dry friction has three quarters of its force, rad/s or m/s (default: fitted for each joint)."""
    by: Literal["torques", "motions", "both"] = "torques"
    """Fit to torques of filtered motions, to motions simulated with the torques (output error), or to both."""
    window: Unstated[float] = None
    """Length of the simulated windows of --by motions and both, s (default: chosen by cross-validation within the
    training data, which may also keep the parameters fitted to torques)."""
    uncertainty: bool = True
    """Estimate the uncertainty of the torques, which also flags states out of distribution."""
    robust: bool = False
    """Use Huber's robust estimate, for torques with spikes."""


@dataclass(frozen=True, kw_only=True)
class Arguments(Drawn, Folder, Filtered, Robot):
    """The robot, the data, how it is identified, and where the results go."""


def main(options: Arguments) -> None:
    """Identifies the robot, evaluates the model and writes the run folder."""
    from dln_jax.commands.identification.run import run

    run(options)
