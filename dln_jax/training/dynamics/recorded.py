"""Reads the data that a command names, with their `Needs`, robot file and kinematic prior."""

from typing import NamedTuple

import numpy as np

from dln_jax.data import schema
from dln_jax.data.encoders.smoothing import labels_of_parts
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, LEAST_TRAJECTORIES, Split, in_blocks, split, with_joints
from dln_jax.data.stated_tests import is_cut, stated_test
from dln_jax.files import read_json
from dln_jax.learning.kinematics.frames import KinematicPrior, kinematic_prior_from_json
from dln_jax.models.trees import USUAL
from dln_jax.runs.arguments import names_listed, refuse_given, require_positive_if_given
from dln_jax.runs.encoders import facts, fitted_torque, needs_from_option, prepare_log, without_torque
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST, default_data
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.registry import scene_named
from dln_jax.scenes.scene import Scene
from dln_jax.training.dynamics.options import AUTO, ArmOptions, Options, SelectionOptions
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import entry_of

USES = ("training", "validation", "the test")
"""Uses of the parts of a split, in their order."""


class Recorded(NamedTuple):
    """The data that the arguments name, and what is known about the plant."""

    name: str
    sets: Split
    scene: Scene | None
    needs: Needs
    needs_origin: str
    lines: tuple[str, ...]
    """Lines for the user: the origin of the rates, and findings about the data."""
    cutoff: float | None
    """Cut-off of the filter applied to q, Hz; `None` without a filter."""
    robot: Robot | None
    """The robot that moved, if its file was stated."""
    parents: tuple[int, ...] | None
    kinematic_prior: KinematicPrior | None
    torque: str = "measured torques"
    """The torques that models are fitted to and uncertainty bands refer to."""
    torque_noise: np.ndarray | None = None
    """Standard deviation of the noise of filtered torques, N m or N [d]; `None` if they are not filtered."""
    blocks: bool = False
    """Whether recordings were cut into blocks of time to have validation and test data."""
    causes: tuple[str, ...] = ()
    """Faults that the check found in the log and that no filter repairs."""


def read(options: Options) -> Recorded:
    """Reads and checks the data and robot that the arguments name, before anything is written."""
    scene = scene_named(options.scene) if options.scene else None
    parts = options.test if is_cut(options.test) else None
    labels = None if parts or not options.test else [label.strip() for label in options.test.split(",")]
    robot = robot_of(options)
    if options.data is None:
        refuse_given(options, ["rate", "units", "joints", "topics", "torque_factor"], "for a file: add --data")
    if options.data is not None:
        names = () if robot is None else robot.tree.names
        data, name = schema.load(options.data, **facts(options), robot=names), str(options.data)
    else:
        scene = scene or two_link_arm()
        data, name = default_data(scene), f"default data of {scene.name}"
        if labels is None and not parts and scene.name == "two-link-arm":
            labels = list(CHARACTERS_TEST)
    if robot is not None:
        data = with_joints(data, robot.tree.names)
    needs, origin = stated_needs(options, scene, data, robot)
    if needs.degrees_of_freedom != data.degrees_of_freedom:
        raise InputError(
            f"{origin} has {needs.degrees_of_freedom} joints, but {name} has {data.degrees_of_freedom}; make them agree"
        )
    if "tau" in data.estimated:
        raise InputError(
            f"{name}: there is no tau, which models of torques are fitted to; add the measured torques, or fit motions "
            f"without applied forces by: python -m scripts.train_hnn_task --task measured --data {name}"
            f"{without_torque(data)}"
        )
    if robot is not None and needs.joints != robot.tree.joints:
        raise InputError(
            f"{origin} has joints {'-'.join(needs.joints)}, the robot {'-'.join(robot.tree.joints)}; make them agree"
        )
    data = data._replace(needs=needs)
    rubbing = bool(needs.friction or needs.joint_friction)
    cut = labels is None and (parts or len(np.unique(data.trajectory)) < LEAST_TRAJECTORIES)
    settled = ("repeated-motions", *["split"] * bool(cut), *["friction"] * rubbing)
    filtered, lines, causes, robot = prepare_log(options, data, options.data, robot=robot, without=settled)
    if filtered is not None:
        data = filtered.data
        labels = None if labels is None else labels_of_parts(data, labels)
    recordings = len(np.unique(data.trajectory))
    if parts:
        data, labels = stated_test(data, parts)
    elif cut and recordings < LEAST_TRAJECTORIES:
        data = in_blocks(data, BLOCKS)
    parents = parents_of(options, needs.degrees_of_freedom)
    whole = len(np.unique(data.trajectory)) == recordings
    motion = motion_numbers(data.q, data.trajectory) if whole else None  # blocks of one motion may look alike
    sets = split(data, test=labels, seed=options.seed, motion=motion)
    lines += filter(None, [remark_on_repeats([sets.train, sets.validation], sets.test, motion)])
    if not whole:
        counts = [f"{len(np.unique(part.trajectory))} for {use}" for part, use in zip(sets, USES, strict=True)]
        which = "one recording" if recordings == 1 else f"{recordings} recordings"
        lines.append(f"{which}: cut into blocks of time, {', '.join(counts)}")
    return Recorded(
        name=name,
        sets=sets,
        scene=scene,
        needs=needs,
        needs_origin=origin,
        lines=tuple(lines),
        cutoff=None if filtered is None else filtered.cutoff,
        robot=robot,
        parents=parents,
        kinematic_prior=kinematic_prior_of(options, needs.degrees_of_freedom, parents),
        torque=fitted_torque(filtered),
        torque_noise=None if filtered is None or not filtered.filtered_torque else filtered.noise_tau,
        blocks=not whole,
        causes=causes,
    )


def stated_needs(options: Options, scene: Scene | None, data: Trajectories, robot: Robot | None) -> tuple[Needs, str]:
    """`Needs` of the plant and their origin: the command line, the scene, the file, the robot, or an assumption."""
    needs, origin = _needs_and_origin(options, scene, data, robot)
    require_positive_if_given(options, ["velocity_scale"])
    if needs.friction and (options.model == AUTO or entry_of(str(options.model)).properties.searched):
        # All candidates of a selection get the same friction, so that none wins by friction alone.
        needs = needs._replace(friction=False, joint_friction=needs.joint_friction or USUAL)
    scale = options.velocity_scale
    if scale is None:
        return needs, origin
    if not needs.joint_friction:
        raise InputError(
            "--velocity-scale is for dry friction of joints, which the needs do not state; "
            'add --needs with "joint_friction", or leave it out'
        )
    return needs._replace(velocity_scale=scale), origin


def _needs_and_origin(
    options: Options, scene: Scene | None, data: Trajectories, robot: Robot | None
) -> tuple[Needs, str]:
    if options.needs is not None:
        return needs_from_option(options.needs), "--needs"
    if scene is not None:
        return scene.needs, f"scene {scene.name}"
    if data.needs is not None:
        return data.needs, "the data file"
    if robot is not None:
        return robot.tree.needs._replace(joint_friction=USUAL), "the robot's file, and friction"
    needs = Needs(joints=("revolute",) * data.degrees_of_freedom, joint_friction=USUAL)
    return needs, "assumed: neither the file nor --needs says"


def robot_of(options: Options) -> Robot | None:
    """Reads the robot of --robot."""
    if not isinstance(options, SelectionOptions):
        return None
    if options.robot is None:
        refuse_given(options, ["lock"], "for joints of --robot")
        return None
    return read_robot(options.robot, lock=names_listed(options.lock))


def parents_of(options: Options, d: int) -> tuple[int, ...] | None:
    """Parses --parents into parents counted from 0, as everywhere else in the code."""
    if not isinstance(options, ArmOptions) or options.parents is None:
        return None
    try:
        parents = tuple(int(number) - 1 for number in options.parents.split(","))
    except ValueError:
        parents = ()
    if len(parents) != d or any(not -1 <= parent < link for link, parent in enumerate(parents)):
        raise InputError(
            f"--parents is {options.parents!r:.60}; expected {d} whole numbers separated by commas: joints before, "
            "counted from 1, or 0 for the ground"
        )
    return parents


def kinematic_prior_of(options: Options, d: int, parents: tuple[int, ...] | None) -> KinematicPrior | None:
    """Reads the kinematic prior of --kinematic-prior."""
    if not isinstance(options, ArmOptions) or options.kinematic_prior is None:
        return None
    try:
        return kinematic_prior_from_json(read_json(options.kinematic_prior, remedy="see --help"), d, parents)
    except InputError as error:
        text = str(error)
        raise InputError(
            text if str(options.kinematic_prior) in text else f"{options.kinematic_prior}: {text}"
        ) from None
