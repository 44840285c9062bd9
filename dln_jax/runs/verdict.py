"""Verdict on a fit of dynamics by its test: torques, accelerations, mass matrices, rollouts and the search."""

import jax
import numpy as np

from dln_jax.data.encoders.sampling import torque_noise
from dln_jax.data.log import Log, Parts
from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import merged
from dln_jax.learning.fit import Fit
from dln_jax.learning.kinematics.fit import TreeFit
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.metrics.errors import definiteness
from dln_jax.metrics.motions import Motion
from dln_jax.metrics.verdict import FAR_FROM_NOISE, HeldOut, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.precision import quick_compilation

AT_NOISE = 2.0
"""Held-out errors of a tree with unknown frames, in units of the noise variance, up to which its frames are right;
above `FAR_FROM_NOISE` they may be wrong."""
QUANTITIES = {"test": "torque", "validation": "validation torque"}


def verdict_of(
    fit: Fit,
    parts: Parts,
    log: Log,
    answers: dict[str, np.ndarray],
    motions: list[Motion],
) -> tuple[Verdict, dict[str, float | int]]:
    """The most severe verdict from held-out motions, mass matrices, rollouts and the search, and its metrics.

    Accelerations are judged if the model is fitted to them.

    Args:
        answers: the model's `tau` and `qdd` [N, d] on the test motions, followed by the validation motions.
        motions: rollouts of the test motions, possibly none.
    """
    sets, robot, numbers = parts.sets, log.robot, {}
    noise = torque_noise(sets.train) if log.torque_noise is None else log.torque_noise
    whole, names = merged(sets), None if robot is None else robot.tree.names
    count = len(sets.test.t)
    judged = {"test": (slice(count), sets.test), "validation": (slice(count, None), sets.validation)}
    judged = {name: (part, data) for name, (part, data) in judged.items() if len(data.t)}
    held = {
        name: held_out(
            answers["tau"][part],
            data.tau,
            noise=noise,
            file=None if robot is None else torques_of(robot, data),
            recording=whole.tau if parts.blocks else None,
        )
        for name, (part, data) in judged.items()
    }
    verdicts = [judge(errors, names, quantity=QUANTITIES[part]) for part, errors in held.items()]
    if not fit.objective.of_torques:
        recording = whole.qdd if parts.blocks else None
        for part, data in judged.values():
            errors = held_out(answers["qdd"][part], data.qdd, recording=recording)
            verdicts.append(judge(errors, names, quantity="acceleration"))
    properties = fit.properties
    remedy = f"try another --degree, --model {'structured-hnn' if properties.canonical else 'structured-delan'}, "
    remedy += "or more varied motions"
    if infinite := sum(not np.isfinite([motion.q, motion.qd]).all() for motion in motions):
        reason = f"{infinite} of {len(motions)} rollouts of test motions are not finite"
        verdicts.append(Verdict("doubtful", reason, remedy))
    if properties.energy and not properties.definite:
        smallest, share, condition = definiteness(fit.dynamics, whole.q, whole.qd)
        if share > 0:
            reason = (
                f"the mass matrix is not positive definite at {share:.1%} of the states of the data: accelerations and "
                "rollouts are wrong or infinite there"
            )
            verdicts.append(Verdict("refused" if share == 1 else "doubtful", reason, remedy))
        numbers["smallest_mass_eigenvalue"] = smallest
        numbers["share_not_definite"] = share
        numbers["largest_condition_number"] = condition
    if fit.search is not None:
        of_search, of_descents = verdict_on_search(fit.search, held["test"])
        verdicts += [] if of_search is None else [of_search]
        numbers = of_descents | numbers
    verdict = worst(*verdicts, causes=log.faults)
    nmse = {f"{name}_nmse": float(np.mean(errors.error / errors.unit)) for name, errors in held.items()}
    return verdict, {**nmse, **verdict_metrics(held["test"], verdict), **numbers}


def torques_of(robot: Robot, data: Trajectories) -> np.ndarray:
    """Torques [N, d] by the robot's file, friction included."""
    motion = dynamics(tree_system(robot.tree, joint_dissipation(robot.damping, robot.coulomb)))
    return np.asarray(
        jax.jit(jax.vmap(motion.inverse_dynamics), compiler_options=quick_compilation())(data.q, data.qd, data.qdd)
    )


def verdict_on_search(search: TreeFit, errors: HeldOut) -> tuple[Verdict | None, dict[str, float | int]]:
    """Verdict and metrics of a search for joint frames: agreement of its descents, and their errors over the noise."""
    count, agreeing, twin = len(search.losses), search.agreeing, search.twin
    numbers: dict[str, float | int] = {"descents": count, "descents_agreeing": agreeing}
    if twin is not None:
        off = {"twin_degrees": float(np.degrees(twin.off.angle)), "twin_metres": twin.off.length}
        numbers |= {**off, "twin_error": twin.error}
    above = None
    if errors.noise is not None and (errors.noise > 0).all():
        above = float(np.mean(errors.error / errors.noise))
        numbers |= {"error_over_noise": above}
        if above <= AT_NOISE:
            return None, numbers
    if agreeing < search.agreement:
        reason = f"only {agreeing} of {count} starts reached the lowest loss; a lower loss may exist"
        remedy = "try another --seed, more --seconds or a --kinematic-prior of the arm"
    elif twin is not None and not twin.same:
        reason = f"two starts with the same loss {twin.words}; the motions do not determine the axes"
        remedy = "record more and different motions, or add a --kinematic-prior"
    elif above is not None and above > FAR_FROM_NOISE:
        reason = f"held-out errors are {above:.2g} times the noise, although {agreeing} starts agree"
        remedy = "record more and different motions, or add a --kinematic-prior; missing friction has the same effect"
    else:
        return None, numbers
    return Verdict("doubtful", reason, remedy), numbers
