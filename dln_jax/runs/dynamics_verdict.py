"""Whether a model of dynamics may be used: held-out torques, and what its fit says of itself."""

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders import torque_noise
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import tree_system
from dln_jax.metrics.verdict import HeldOut, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.runs.dynamics_task import Task

AT_NOISE, FAR_FROM_NOISE = 2.0, 4.0
"""Held-out errors of a tree of unknown frames, in units of the noise's variance: up to the first its frames are right,
above the second they may be wrong."""


def judged(task: Task, predicted: np.ndarray) -> tuple[Verdict | None, dict[str, float | int]]:
    """The verdict on a task's model by its torques on the test motions [N, d], and its entries of metrics.json.

    `None` for a model that is not fitted to torques alone.
    """
    if not task.objective.of_torques:
        return None, {}
    test, robot = task.sets.test, task.recorded.robot
    file = None if robot is None else torques_of(robot, test)
    names = None if robot is None else robot.tree.names
    found = held_out(predicted, test.tau, noise=torque_noise(task.sets.train), file=file)
    verdict = judge(found, names)
    own, numbers, search = None, {}, task.search
    if search is not None:
        own, numbers = searched(search.losses, search.agreeing, search.agreement, found)
    verdict = verdict if own is None else worst(verdict, own)
    return verdict, verdict_metrics(found, verdict) | numbers


def torques_of(robot: Robot, data: Trajectories) -> np.ndarray:
    """Torques [N, d] of the robot as its file describes it, friction included."""
    motion = dynamics(tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb)))
    every = jax.jit(jax.vmap(motion.inverse_dynamics), compiler_options=quick_compilation())
    return np.asarray(every(data.q, data.qd, data.qdd))


def searched(
    losses: np.ndarray, agreeing: int, agreement: int, found: HeldOut
) -> tuple[Verdict | None, dict[str, float | int]]:
    """What a search for joint frames says of itself: whether descents agree, and how far from the noise they end.

    Args:
        losses: of all descents.
        agreeing: descents that reached the lowest.
        agreement: how many the search wanted to.
        found: errors on held-out motions.
    """
    numbers: dict[str, float | int] = {"descents": len(losses), "descents_agreeing": agreeing}
    above = None
    if found.noise is not None and (found.noise > 0).all():
        above = float(np.mean(found.error / found.noise))
        numbers |= {"error_over_noise": above}
        if above <= AT_NOISE:
            return None, numbers
    if agreeing < agreement:
        reason = f"only {agreeing} of {len(losses)} descents reached the lowest loss, so a lower one may exist"
        remedy = "try another --seed, more --seconds or a --sketch of the arm"
        return Verdict("doubtful", reason, remedy), numbers
    if above is not None and above > FAR_FROM_NOISE:
        reason = f"held-out errors are {above:.2g} times the noise, though {agreeing} descents agree"
        remedy = "record more and different motions, or add a --sketch; friction that the tree lacks looks the same"
        return Verdict("doubtful", reason, remedy), numbers
    return None, numbers
