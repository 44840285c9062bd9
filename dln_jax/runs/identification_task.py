"""From options to a robot that is to be identified: its file, the data, and what they are judged by."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.command_line.arguments import Unstated
from dln_jax.command_line.options import Drawn, Folder
from dln_jax.data import schema
from dln_jax.data.joints import with_joints
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import in_blocks, label_indices, require_no_copies, select
from dln_jax.identification.consistent import REGULARISATION
from dln_jax.mechanics.trees import tree_to_json
from dln_jax.models.model import Model, Parameters
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import Description, build, describe

BLOCKS = 10
"""Of one trajectory, where there is no other to be judged by."""
HELD_OUT = slice(2, None, 5)
"""Of trajectories or blocks: the third of every five."""


@dataclass(frozen=True, kw_only=True)
class Options(Folder, Drawn):
    """The robot, the data, and how it is identified."""

    robot: Path
    """URDF or MJCF file: the kinematics, and values to start from. It stays as it is."""
    data: Path
    """Trajectories in the npz schema, with tau; joint_names are matched with the robot's where they are there."""
    test: Unstated[str] = None
    """Labels of the held-out trajectories, comma separated (default: the third of every five; of one trajectory, of ten
    blocks of time)."""
    friction: bool = True
    """Viscous and dry friction and an offset of each joint are identified, too."""
    velocity_scale: float = 0.01
    """rad/s or m/s at which dry friction has three quarters of its force; it is not fitted."""
    noise: Unstated[str] = None
    """Standard deviation of each joint's torque, N m or N, comma separated (default: estimated)."""
    robust: bool = False
    """Huber's estimate, for torques with spikes."""
    consistent: bool = True
    """Keep bodies that exist, with positive armature and friction; else what least squares gives."""
    regularisation: float = REGULARISATION
    """Of consistent parameters towards those of the robot's file; dimensionless, 1 is about one measurement."""


class Sets(NamedTuple):
    """Fitted to, and judged by."""

    train: Trajectories
    test: Trajectories
    blocks: bool
    """Whether they are blocks of one trajectory."""


class Case(NamedTuple):
    """A robot and its data, ready to be identified."""

    robot: Robot
    names: tuple[str, ...]
    sets: Sets
    description: Description
    model: Model
    known: Parameters
    """Of the file."""
    noise: np.ndarray | None
    """Where it is stated."""

    @property
    def friction(self) -> bool:
        """Whether it is identified."""
        return self.description["needs"]["friction"]


def prepare(given: Options) -> Case:
    """Reads and checks everything that the options name, before anything is written."""
    robot = read_robot(given.robot)
    d = robot.tree.degrees_of_freedom
    try:
        data = with_joints(schema.load(given.data), robot.tree.names)
    except InputError as error:
        raise InputError(str(error) if str(given.data) in str(error) else f"{given.data}: {error}") from None
    needs = robot.tree.needs._replace(friction=given.friction)
    description = describe(
        "rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree), velocity_scale=given.velocity_scale
    )
    model = build(description)
    known = model.init(jax.random.key(0))
    stated = {"viscous": robot.damping, "coulomb": robot.coulomb}
    known = known._replace(
        **{name: jnp.asarray(values) for name, values in stated.items() if getattr(known, name) is not None}
    )
    return Case(robot, robot.tree.names, split(data, given.test), description, model, known, noises(given.noise, d))


def split(data: Trajectories, test: str | None) -> Sets:
    """Held-out trajectories, or blocks of time where there is one trajectory only."""
    if len(np.unique(data.trajectory)) == 1:
        if test is not None:
            raise InputError("--test names trajectories, and the data have one only; leave it out for blocks of time")
        return split(in_blocks(data, BLOCKS), None)._replace(blocks=True)
    present = np.unique(data.trajectory)
    held = present[HELD_OUT] if len(present) > 2 else present[-1:]
    if test is not None:
        held = label_indices(data, [label.strip() for label in test.split(",")])
    rest = np.setdiff1d(present, held)
    if not len(rest) or not len(np.intersect1d(held, present)):
        raise InputError("--test leaves no trajectory to fit, or none to judge by; name fewer, or others")
    sets = Sets(select(data, rest), select(data, held), blocks=False)
    require_no_copies(sets.train, sets.test)
    return sets


def noises(stated: str | None, d: int) -> np.ndarray | None:
    """Of --noise."""
    if stated is None:
        return None
    try:
        found = np.array([float(each) for each in stated.split(",")])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (d,) or not (found > 0).all() or not np.isfinite(found).all():
        raise InputError(f"--noise is {stated!r:.60}; expected {d} positive numbers with commas between them")
    return found
