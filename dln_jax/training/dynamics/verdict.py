"""Judges a trained model of dynamics: held-out torques and accelerations, mass matrices, rollouts, and its search."""

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.encoders.sampling import torque_noise
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import merged
from dln_jax.learning.kinematics.agreement import Twin
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction.curves import joint_dissipation
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.metrics.errors import Definiteness, definiteness
from dln_jax.metrics.motions import Motion
from dln_jax.metrics.verdict import (
    FAR_FROM_NOISE,
    HeldOut,
    Verdict,
    held_out,
    judge,
    verdict_metrics,
    worst,
)
from dln_jax.training.dynamics.task import Task
from dln_jax.zoo.catalogue import CATALOGUE

AT_NOISE = 2.0
"""Held-out errors of a tree with unknown frames, in units of the noise variance, up to which its frames are right;
above `FAR_FROM_NOISE` they may be wrong."""


def judge_fit(
    task: Task,
    functions: Dynamics | PlainDynamics,
    answers: dict[str, np.ndarray],
    motions: list[Motion],
) -> tuple[Verdict, dict[str, float | int]]:
    """The most severe verdict from held-out motions, mass matrices, rollouts and the search, and its metrics.

    Accelerations are judged if the model is fitted to them.

    Args:
        functions: the model.
        answers: the model's `tau` and `qdd` [N, d] on the test motions, followed by the validation motions.
        motions: rollouts of the test motions, possibly none.
    """
    recorded, sets, robot, numbers = task.recorded, task.sets, task.recorded.robot, {}
    noise = torque_noise(sets.train) if recorded.torque_noise is None else recorded.torque_noise
    whole, names = merged(sets), None if robot is None else robot.tree.names
    held = len(sets.test.t)
    parts = ((slice(held), sets.test), (slice(held, None), sets.validation))
    tested, validated = (
        held_out(
            answers["tau"][part],
            data.tau,
            noise=noise,
            file=None if robot is None else torques_of(robot, data),
            recording=whole.tau if recorded.blocks else None,
        )
        for part, data in parts
    )
    verdicts = [judge(tested, names), judge(validated, names)]
    if not task.objective.of_torques:
        recording = whole.qdd if recorded.blocks else None
        accelerations = [held_out(answers["qdd"][part], data.qdd, recording=recording) for part, data in parts]
        verdicts += [judge(errors, names, quantity="acceleration") for errors in accelerations]
    definite = definiteness_of(functions, task, whole)
    verdicts += judge_mechanics(task, definite, motions)
    if task.search is not None:
        of_search, numbers = searched(
            task.search.losses, task.search.agreeing, task.search.agreement, tested, task.search.twin
        )
        verdicts += [] if of_search is None else [of_search]
    if definite is not None:
        numbers |= {"smallest_mass_eigenvalue": definite.smallest_eigenvalue, **definite._asdict()}
        del numbers["smallest_eigenvalue"]
    verdict = worst(*verdicts, causes=recorded.causes)
    nmse = {"test_nmse": _nmse(tested), "validation_nmse": _nmse(validated)}
    return verdict, {**nmse, **verdict_metrics(tested, verdict), **numbers}


def definiteness_of(functions: Dynamics | PlainDynamics, task: Task, data: Trajectories) -> Definiteness | None:
    """Definiteness of the mass matrices along the data; `None` for a model without energy or definite by structure."""
    properties = CATALOGUE[task.kind].properties
    if properties.definite or not properties.energy:
        return None
    return definiteness(functions, data.q, data.qd)


def judge_mechanics(task: Task, definite: Definiteness | None, motions: list[Motion]) -> list[Verdict]:
    """Verdicts on mass matrices that are not positive definite and on rollouts that are not finite."""
    structured = "structured-hnn" if CATALOGUE[task.kind].properties.canonical else "structured-delan"
    remedy = f"try another --degree, --model {structured}, or more varied motions"
    infinite = sum(not np.isfinite([motion.q, motion.qd]).all() for motion in motions)
    verdicts = []
    if infinite:
        reason = f"{infinite} of {len(motions)} rollouts of test motions are not finite"
        verdicts.append(Verdict("doubtful", reason, remedy))
    if definite is not None and definite.share_not_definite > 0:
        share = definite.share_not_definite
        reason = (
            f"the mass matrix is not positive definite at {share:.1%} of the states of the data: accelerations and "
            "rollouts are wrong or infinite there"
        )
        verdicts.append(Verdict("refused" if share == 1 else "doubtful", reason, remedy))
    return verdicts


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
