"""Builds an identification task from options: the robot's file, its data, and the held-out part."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.cli.arguments import (
    Unstated,
    choice,
    names_in,
    names_listed,
    numbers_of,
    require_positive_if_given,
)
from dln_jax.cli.encoders import Filtered, checked, fitted_torque, preparation, smoothed
from dln_jax.cli.options import Drawn, Folder
from dln_jax.data import schema
from dln_jax.data.encoders import labels_of_parts
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, every, in_blocks, label_indices, require_no_copies, select, with_joints
from dln_jax.identification.consistent import REGULARISATION
from dln_jax.learning.friction import fit_friction
from dln_jax.mechanics.friction import LAWS, FrictionShape, require_laws, shape_of
from dln_jax.mechanics.trees import tree_to_json
from dln_jax.models.model import Parameters
from dln_jax.models.rigid_tree import USUAL
from dln_jax.types import FrictionLaw, InputError
from dln_jax.zoo.descriptions import Description, build, describe

IDENTIFIED = tuple(law for law in LAWS if law != "load")
"""Friction laws in whose coefficients forces are linear."""
NO_FRICTION = "none"
SETTLED = ("split", "friction", "condition")
"""Checks of a log that the robot's file and this command make unnecessary."""
MOST_SAMPLES = 4_000
"""Largest number of samples used to fit the shapes of friction."""
HELD_OUT = slice(2, None, 5)
"""Trajectories or blocks held out: the third of every five."""


@dataclass(frozen=True, kw_only=True)
class Options(Folder, Drawn, Filtered):
    """The robot, the data, and how it is identified."""

    robot: Path
    """URDF or MJCF file: the kinematics, and values to start from. It stays as it is."""
    data: Path
    """Trajectories as npz or CSV, with tau; joint_names are matched with the robot's where they are there."""
    test: Unstated[str] = None
    """Labels of the held-out trajectories, comma separated (default: the third of every five; of one trajectory, of ten
    blocks of time)."""
    lock: Unstated[str] = None
    """Joints of the file that do not move, such as those of a gripper, comma separated; "*finger*" names all with
    finger in their name (default: all joints move)."""
    friction: Annotated[str, choice((*IDENTIFIED, NO_FRICTION), several=True)] = ",".join(USUAL)
    """Laws of friction of each joint, whose coefficients are identified, too (default: viscous,coulomb,offset)."""
    velocity_scale: Unstated[float] = None
    """rad/s or m/s at which dry friction has three quarters of its force (default: fitted, one for each joint; so are
    the other numbers that friction is not linear in)."""
    uncertainty: bool = True
    """Say of any state how uncertain its torque is, and whether it is outside the data."""
    residual: bool = False
    """Add a small network for what the rigid robot leaves unexplained, if held-out motions ask for one."""
    noise: Unstated[str] = None
    """Standard deviation of each joint's torque, N m or N, comma separated (default: estimated)."""
    robust: bool = False
    """Huber's estimate, for torques with spikes."""
    consistent: bool = True
    """Keep bodies physically consistent, with positive armature and friction; else what least squares gives."""
    regularisation: float = REGULARISATION
    """Of consistent parameters towards those of the robot's file; dimensionless, 1 is about one measurement."""


class Sets(NamedTuple):
    """Training and held-out data."""

    train: Trajectories
    test: Trajectories
    blocks: bool
    """Whether the parts are blocks of one trajectory."""


class Case(NamedTuple):
    """A robot and its data, ready for identification."""

    robot: Robot
    names: tuple[str, ...]
    sets: Sets
    description: Description
    model: Any
    known: Parameters
    """Parameters in the robot's file."""
    noise: np.ndarray | None
    """Noise of the torques, if stated."""
    held: tuple[str, ...]
    """Names of the locked joints."""
    said: tuple[str, ...]
    """Lines for the user: the origin of the rates, and findings about the log."""
    torque: str = "measured torques"
    """The torques that the fit and its uncertainty bands refer to."""

    @property
    def laws(self) -> tuple[FrictionLaw, ...]:
        """Friction laws that are identified."""
        return tuple(self.description["needs"]["joint_friction"])


def prepare(given: Options) -> Case:
    """Reads and checks everything that the options name, before anything is written."""
    held = names_listed(given.lock)
    robot = read_robot(given.robot, lock=held)
    laws = () if given.friction == NO_FRICTION else tuple(names_in("--friction", given.friction, IDENTIFIED))
    require_laws(laws, "--friction")
    require_positive_if_given(given, ["velocity_scale"])
    try:
        data = with_joints(schema.load(given.data, rate=given.rate, units=given.units), robot.tree.names)
    except InputError as error:
        raise InputError(str(error) if str(given.data) in str(error) else f"{given.data}: {error}") from None
    if "tau" in data.estimated:
        raise InputError(f"{given.data}: the data have no tau; identification takes measured torques")
    found = smoothed(given, data)
    said = (*preparation(data, found), *checked(given, data, given.data, robot=robot, without=SETTLED))
    labels = [label.strip() for label in given.test.split(",")] if given.test else None
    if found is not None:
        labels = labels and labels_of_parts(found.data, labels)
        data = found.data._replace(joint_names=data.joint_names)
    needs = robot.tree.needs._replace(joint_friction=cast(tuple[FrictionLaw, ...], laws))
    scale = {} if given.velocity_scale is None else {"velocity_scale": given.velocity_scale}
    description = describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree), **scale)
    noise = noises(given.noise, robot.tree.degrees_of_freedom)
    sets = split(data, labels)
    torque = fitted_torque(found)
    return with_description(Case(robot, robot.tree.names, sets, description, None, None, noise, held, said, torque))


def with_description(case: Case, **changes: Any) -> Case:
    """The case with changed keywords of its model, which is built again."""
    description = {**case.description, **changes}
    model = build(description)
    known = model.init(jax.random.key(0))
    stated = {"viscous": case.robot.damping, "coulomb": case.robot.coulomb}
    known = known._replace(
        **{name: jnp.asarray(values) for name, values in stated.items() if getattr(known, name) is not None}
    )
    return case._replace(description=description, model=model, known=known)


def with_shapes(velocity_scale: float | None, case: Case) -> Case:
    """The case with friction curves whose shapes are fitted to the training data; unchanged if there is nothing to fit.

    The velocity scale is fitted unless it is stated.
    """
    held = () if velocity_scale is None else ("velocity_scale",)
    if not set(shape_of(case.laws)) - set(held):
        return case
    thin = -(-len(case.sets.train.t) // MOST_SAMPLES)
    start = FrictionShape(**({} if velocity_scale is None else {"velocity_scale": velocity_scale}))
    fitted = fit_friction(
        case.robot.tree, every(case.sets.train, thin), case.laws, shape=start, held=held, noise=case.noise
    )
    return with_description(case, **{name: values.tolist() for name, values in fitted.shape.items()})


def for_residual(train: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training data of a residual network, and every fourth trajectory or block as validation for its size."""
    present = np.unique(train.trajectory)
    chosen = present[1::4]
    if not len(chosen):
        raise InputError("--residual takes two trajectories or blocks to fit at least; record more motions")
    return select(train, np.setdiff1d(present, chosen)), select(train, chosen)


def split(data: Trajectories, test: list[str] | None) -> Sets:
    """Training and held-out trajectories, or blocks of time if there is only one trajectory."""
    if len(np.unique(data.trajectory)) == 1:
        if test is not None:
            raise InputError("--test names trajectories, and the data have one only; leave it out for blocks of time")
        return split(in_blocks(data, BLOCKS), None)._replace(blocks=True)
    present = np.unique(data.trajectory)
    held = present[HELD_OUT] if len(present) > 2 else present[-1:]
    if test is not None:
        held = label_indices(data, test)
    rest = np.setdiff1d(present, held)
    if not len(rest) or not len(np.intersect1d(held, present)):
        raise InputError("--test leaves no trajectory to fit, or none to judge by; name fewer, or others")
    sets = Sets(select(data, rest), select(data, held), blocks=False)
    require_no_copies(sets.train, sets.test)
    return sets


def noises(stated: str | None, d: int) -> np.ndarray | None:
    """Parses --noise."""
    if stated is None:
        return None
    return np.array(numbers_of("--noise", stated, [d], positive=True))
