"""Judges a trained model of dynamics by its torques on held-out motions and by its search for joint frames."""

from typing import NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders import torque_noise
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import merged
from dln_jax.learning.kinematics import Twin
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import tree_system
from dln_jax.metrics.verdict import HeldOut, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.training.dynamics.task import Task

AT_NOISE, FAR_FROM_NOISE = 2.0, 4.0
"""Held-out errors of a tree with unknown frames, in units of the noise variance: up to the first its frames are right,
above the second they may be wrong."""


class TorqueVerdict(NamedTuple):
    """A verdict and the numbers behind it."""

    verdict: Verdict | None
    """`None` for a model that is not fitted to torques alone."""
    metrics: dict[str, float | int]
    """Entries of metrics.json."""
    validation_nmse: float
    """Mean over joints of the squared error, relative to the torque's variance."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """A line if a constant torque would be closer than the model."""
        if self.verdict is None or self.validation_nmse <= 1:
            return ()
        return (
            f"warning: on validation motions the torque's mean square error is {self.validation_nmse:.3g} times its "
            "variance: a constant torque would be closer than this model",
        )


def judge_torques(task: Task, on_test: np.ndarray, on_validation: np.ndarray) -> TorqueVerdict:
    """The most severe verdict from test motions, validation motions and the search for joint frames.

    Args:
        on_test: the model's torques on the test motions [N, d].
        on_validation: the model's torques on the validation motions.
    """
    if not task.objective.of_torques:
        return TorqueVerdict(None, {}, float("nan"))
    test, validation, robot = task.sets.test, task.sets.validation, task.recorded.robot
    noise = torque_noise(task.sets.train) if task.recorded.torque_noise is None else task.recorded.torque_noise
    recording = merged(task.sets).tau if task.recorded.blocks else None
    tested, validated = (
        held_out(
            tau, data.tau, noise=noise, file=None if robot is None else torques_of(robot, data), recording=recording
        )
        for tau, data in ((on_test, test), (on_validation, validation))
    )
    names = None if robot is None else robot.tree.names
    verdict, numbers = worst(judge(tested, names), judge(validated, names)), {}
    if task.search is not None:
        of_search, numbers = searched(
            task.search.losses, task.search.agreeing, task.search.agreement, tested, task.search.twin
        )
        verdict = verdict if of_search is None else worst(verdict, of_search)
    nmse = {"test_nmse": _nmse(tested), "validation_nmse": _nmse(validated)}
    return TorqueVerdict(verdict, {**nmse, **verdict_metrics(tested, verdict), **numbers}, nmse["validation_nmse"])


def _nmse(errors: HeldOut) -> float:
    return float(np.mean(errors.error / errors.unit))


def torques_of(robot: Robot, data: Trajectories) -> np.ndarray:
    """Torques [N, d] by the robot's file, friction included."""
    motion = dynamics(tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb)))
    every = jax.jit(jax.vmap(motion.inverse_dynamics), compiler_options=quick_compilation())
    return np.asarray(every(data.q, data.qd, data.qdd))


def searched(
    losses: np.ndarray, agreeing: int, agreement: int, errors: HeldOut, twin: Twin | None = None
) -> tuple[Verdict | None, dict[str, float | int]]:
    """Verdict and metrics of a search for joint frames: agreement of its descents, and their errors over the noise.

    Args:
        agreeing: number of descents that reached the lowest loss.
        agreement: number of agreeing descents that the search aims for.
        twin: comparison of two of these descents.
    """
    numbers: dict[str, float | int] = {"descents": len(losses), "descents_agreeing": agreeing}
    if twin is not None:
        off = {"twin_degrees": float(np.degrees(twin.off.angle)), "twin_metres": twin.off.length}
        numbers |= {**off, "twin_error": twin.error}
    above = None
    if errors.noise is not None and (errors.noise > 0).all():
        above = float(np.mean(errors.error / errors.noise))
        numbers |= {"error_over_noise": above}
        if above <= AT_NOISE:
            return None, numbers
    if agreeing < agreement:
        reason = f"only {agreeing} of {len(losses)} descents reached the lowest loss, so a lower one may exist"
        remedy = "try another --seed, more --seconds or a --kinematic-prior of the arm"
        return Verdict("doubtful", reason, remedy), numbers
    if twin is not None and not twin.same:
        reason = f"two descents to the same loss found {twin.words}, so the motions do not determine the axes"
        return Verdict("doubtful", reason, "record more and different motions, or add a --kinematic-prior"), numbers
    if above is not None and above > FAR_FROM_NOISE:
        reason = f"held-out errors are {above:.2g} times the noise, though {agreeing} descents agree"
        remedy = (
            "record more and different motions, or add a --kinematic-prior; friction that the tree lacks looks the same"
        )
        return Verdict("doubtful", reason, remedy), numbers
    return None, numbers
