"""Reads the robot and the log of an identification, and holds out a part of the log."""

import numpy as np

from dln_jax.commands.identify import Arguments
from dln_jax.data import schema
from dln_jax.data.encoders.smoothing import Smoothed, labels_of_parts
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import (
    BLOCKS,
    by_motion,
    in_blocks,
    label_indices,
    require_no_copies,
    select,
    with_joints,
)
from dln_jax.data.stated_tests import is_cut, stated_test
from dln_jax.runs.arguments import names_listed
from dln_jax.runs.encoders import facts, prepare_log, without_torque
from dln_jax.types import InputError

SETTLED = ("split", "repeated-motions", "friction", "condition")
"""Checks of a log that the robot's file and this command make unnecessary."""
HELD_OUT = slice(2, None, 5)
"""Trajectories or blocks held out: the third of every five."""


def read(options: Arguments) -> tuple[Robot, Trajectories, Smoothed | None, list[str], tuple[str, ...]]:
    """Reads and checks a robot and its log.

    Returns the robot, without gravity if tau holds none; the log as it was read, and filtered if it is to be; lines
    about it; and the faults that no filter repairs.

    Raises:
        InputError: a robot or log that cannot be read or do not belong together, a log without tau, or with errors.
    """
    robot = read_robot(options.robot, lock=names_listed(options.lock))
    try:
        data = with_joints(schema.load(options.data, **facts(options), robot=robot.tree.names), robot.tree.names)
    except InputError as error:
        raise InputError(str(error) if str(options.data) in str(error) else f"{options.data}: {error}") from None
    if "tau" in data.estimated:
        raise InputError(
            f"{options.data}: the data have no tau; identification takes measured torques{without_torque(data)}"
        )
    filtered, lines, causes, measured = prepare_log(options, data, options.data, robot=robot, without=SETTLED)
    return measured or robot, data, filtered, lines, causes


def split(
    data: Trajectories, test: str | None, motion: np.ndarray | None = None, *, in_parts: bool = False
) -> tuple[Trajectories, Trajectories, bool]:
    """Training and held-out trajectories as --test states them, and whether they are blocks of a single trajectory.

    Args:
        motion: motion of every trajectory, as for `data.splits.split`; blocks and last parts of recordings of one
            motion need not stay together.
        in_parts: whether a filter cut trajectories at gaps.
    """
    data, labels = stated_test(data, test)
    if is_cut(test):
        motion = None
    elif labels and in_parts:
        labels = labels_of_parts(data, labels)
    blocks = len(np.unique(data.trajectory)) == 1
    if blocks:
        if labels is not None:
            raise InputError("--test names trajectories, and the data have one only; give last:30%, or leave it out")
        data, motion = in_blocks(data, BLOCKS), None
    present = np.unique(data.trajectory)
    held = by_motion(present, motion, HELD_OUT, least=2) if labels is None else label_indices(data, labels)
    rest = np.setdiff1d(present, held)
    if not len(rest) or not len(np.intersect1d(held, present)):
        raise InputError("--test leaves no trajectory to fit, or none to judge by; name fewer, or others")
    train, held_out = select(data, rest), select(data, held)
    require_no_copies(train, held_out)
    return train, held_out, blocks
